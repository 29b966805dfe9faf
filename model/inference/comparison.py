"""How far one closed surface lies outside or inside another."""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from trimesh import triangles

from model.inference.mesh import Mesh

#: Faces, by their centres, among which the nearest one to a point is sought.
CANDIDATES = 12
#: Name of the scalar on a compared mesh.
SIGNED_DISTANCE = "signed_distance_mm"


def compared(mesh: Mesh, other: Mesh) -> Mesh:
    """The mesh whose only scalar is `SIGNED_DISTANCE`: positive where it lies outside the other one."""
    bare = Mesh(mesh.vertices, mesh.faces, mesh.normals)
    return bare.with_scalars(**{SIGNED_DISTANCE: signed_distance(mesh.vertices, other)})


def signed_distance(points: Float[np.ndarray, "n 3"], surface: Mesh) -> Float[np.ndarray, "n"]:
    """Distance (mm) of points to a closed surface, positive outside.

    The sign is that of the step from the nearest point along the surface's normals, interpolated there.
    """
    corners = surface.vertices[surface.faces]
    count = min(CANDIDATES, len(corners))
    near = np.asarray(cKDTree(corners.mean(axis=1)).query(points, k=[*range(1, count + 1)])[1])
    closest, face = _closest(points, corners, near)
    step = points - closest
    normal = _normals_at(surface, face, closest)
    return np.asarray(np.copysign(np.linalg.norm(step, axis=1), np.einsum("ij,ij->i", step, normal)))


def _closest(
    points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "f 3 3"], near: Int[np.ndarray, "n k"]
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "n"]]:
    """Nearest point on the candidate faces of each point, and its face."""
    closest_point: Any = triangles.closest_point
    found = np.stack([closest_point(corners[candidate], points) for candidate in near.T], axis=1)
    best = np.argmin(np.linalg.norm(found - points[:, None], axis=2), axis=1)
    row = np.arange(len(points))
    return found[row, best], near[row, best]


def _normals_at(
    surface: Mesh, face: Int[np.ndarray, "n"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Normals of the vertices, interpolated at points on faces."""
    to_barycentric: Any = triangles.points_to_barycentric
    weights = to_barycentric(surface.vertices[surface.faces[face]], points)
    return np.asarray(np.einsum("nc,ncd->nd", weights, surface.normals[surface.faces[face]]))
