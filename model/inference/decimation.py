"""Fewer triangles for a closed surface, within a bound of the distance between the two.

Edges are collapsed in the order of Garland and Heckbert's quadrics (Surface simplification using quadric error metrics,
1997) by the package ``fast-simplification``; quadrics bound nothing, so the distance is measured and the strongest
reduction taken that keeps it.
"""

import fast_simplification
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from model.errors import InvalidParameter
from model.inference.mesh import Mesh, is_watertight, vertex_normals
from model.inference.nearest import candidate_faces, nearest_on_surface

#: Shares of the faces that are tried away; when none keeps the bound, the mesh stays as it is.
REDUCTIONS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95)
#: A face is measured at its corners, and between them at as many steps as make its samples as dense as twice the other
#: mesh's faces, at least 2 and at most so many.
MOST_STEPS = 8
#: Faces that meet at a sharper angle than this (cosine), and than any faces did before, are taken for folded.
SHARPEST, SHARPEST_EVER = -0.5, -0.98


def decimated(mesh: Mesh, max_error_mm: float) -> Mesh:
    """A mesh of fewer faces whose Hausdorff distance to the given one is at most a bound; watertight as that one.

    Normals are those of the faces; scalars are taken from the nearest vertex.

    Args:
        max_error_mm: largest distance of a point on either surface to the other (mm); 0 leaves the mesh as it is.

    Raises:
        InvalidParameter: the bound is negative or no number.
    """
    if not (np.isfinite(max_error_mm) and max_error_mm >= 0):
        raise InvalidParameter("The error of a decimation must be 0 mm or more.", part="max_error_mm")
    if mesh.is_empty or max_error_mm == 0:
        return mesh
    least = max(min(SHARPEST, _sharpest(mesh)), SHARPEST_EVER)
    # A weaker reduction may be farther off than a stronger one, so that halving the list would pass some by.
    for reduction in reversed(REDUCTIONS):
        fewer = _reduced(mesh, reduction)
        if is_watertight(fewer) and _sharpest(fewer) >= least and hausdorff_mm(mesh, fewer) <= max_error_mm:
            return fewer
    return mesh


def _reduced(mesh: Mesh, reduction: float) -> Mesh:
    vertices, faces = fast_simplification.simplify(mesh.vertices, mesh.faces.astype(np.int32), reduction)
    return _with_scalars(mesh, np.asarray(vertices, float), np.asarray(faces, np.int64))


def hausdorff_mm(first: Mesh, second: Mesh) -> float:
    """Hausdorff distance of two surfaces (mm): the largest distance from samples of either to the other.

    A distance is to the nearest of some faces close by, so it may come out too large, never too small.
    """
    return max(_farthest(first, second), _farthest(second, first))


def _farthest(sampled: Mesh, other: Mesh) -> float:
    steps = int(np.clip(round(2.0 * (len(other.faces) / len(sampled.faces)) ** 0.5), 2, MOST_STEPS))
    points, corners = _samples(sampled, steps), other.vertices[other.faces]
    near = candidate_faces(points, corners)
    distance = nearest_on_surface(points, corners, near[:, :2]).distance_mm
    # Only the largest is wanted: the other candidates are looked at for the points that may be it.
    far = distance >= np.quantile(distance, 0.95)
    distance[far] = nearest_on_surface(points[far], corners, near[far]).distance_mm
    far = distance > distance[far].max()
    distance[far] = nearest_on_surface(points[far], corners, near[far]).distance_mm
    return float(distance.max())


def _samples(mesh: Mesh, steps: int) -> Float[np.ndarray, "n 3"]:
    """Points on all faces, corners included."""
    parts = [(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]
    inner = np.array([part for part in parts if max(part) < steps]) / steps
    between = np.einsum("sk,fkd->fsd", inner, mesh.vertices[mesh.faces])
    return np.concatenate([mesh.vertices, between.reshape(-1, 3)])


def _sharpest(mesh: Mesh) -> float:
    """Cosine between the normals of the two neighbouring faces that look most apart; -1 where one has no area."""
    tri = mesh.vertices[mesh.faces]
    normals = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    length = np.linalg.norm(normals, axis=1)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    owners = (np.arange(len(edges)) // 3)[order].reshape(-1, 2) if len(edges) % 2 == 0 else np.zeros((0, 2), int)
    if (length == 0).any() or not len(owners):
        return -1.0
    cosine = np.einsum("ij,ij->i", *(normals[owners[:, k]] for k in (0, 1)))
    return float((cosine / length[owners].prod(axis=1)).min())


def _with_scalars(mesh: Mesh, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Mesh:
    nearest = cKDTree(mesh.vertices).query(vertices)[1] if len(vertices) else np.zeros(0, int)
    scalars = {name: values[nearest] for name, values in mesh.scalars.items()}
    return Mesh(vertices, faces, vertex_normals(vertices, faces), scalars)
