"""The nearest point of a surface, sought on some of its faces."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from trimesh import triangles

#: Faces, by their centres, among which the nearest one to a point is sought.
CANDIDATES = 12


class Nearest(NamedTuple):
    """Nearest points of a surface: where they are, how far off (mm), and on which faces."""

    places: Float[np.ndarray, "n 3"]
    distance_mm: Float[np.ndarray, "n"]
    faces: Int[np.ndarray, "n"]


def candidate_faces(points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "f 3 3"]) -> Int[np.ndarray, "n k"]:
    """The `CANDIDATES` faces whose centres are nearest to each point, the nearest first."""
    count = min(CANDIDATES, len(corners))
    return np.asarray(cKDTree(corners.mean(axis=1)).query(points, k=[*range(1, count + 1)])[1])


def nearest_on_surface(
    points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "f 3 3"], candidates: Int[np.ndarray, "n k"]
) -> Nearest:
    """The nearest point on any of the candidate faces of each point; there may be a nearer one on another face."""
    closest_point: Any = triangles.closest_point
    found = Nearest(np.zeros((len(points), 3)), np.full(len(points), np.inf), np.zeros(len(points), np.int64))
    for faces in candidates.T:
        places = closest_point(corners[faces], points)
        distance_mm = np.linalg.norm(places - points, axis=1)
        nearer = distance_mm < found.distance_mm
        for best, one in zip(found, (places, distance_mm, faces), strict=True):
            best[nearer] = one[nearer]
    return found
