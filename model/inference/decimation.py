"""Fewer triangles for a closed surface, within a bound of the distance between the two.

Edges are collapsed in the order of Garland and Heckbert's quadrics (Surface simplification using quadric error metrics,
1997) by the package ``fast-simplification``; quadrics bound nothing, so the distance is measured and the strongest
reduction taken that keeps it. Where a collapse folded two faces onto each other, the fold is mended.
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
#: Folds of a mesh that are looked after, one after the other; a mesh with more is given up.
MOST_FOLDS = 8


def decimated(mesh: Mesh, max_error_mm: float) -> Mesh:
    """A mesh of fewer faces whose Hausdorff distance to the given one is at most a bound; watertight as that one.

    The distance is measured at samples (`hausdorff_mm`); between them it may be larger by a part of their spacing.
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
        fewer = _unfolded(_reduced(mesh, reduction), least)
        if is_watertight(fewer) and _sharpest(fewer) >= least and hausdorff_mm(mesh, fewer) <= max_error_mm:
            return fewer
    return mesh


def _reduced(mesh: Mesh, reduction: float) -> Mesh:
    vertices, faces = fast_simplification.simplify(mesh.vertices, mesh.faces.astype(np.int32), reduction)
    return _with_scalars(mesh, np.asarray(vertices, float), np.asarray(faces, np.int64))


def _unfolded(mesh: Mesh, least: float) -> Mesh:
    """The mesh with its sharpest edges mended, as long as they are sharper than the least and mending helps."""
    for _ in range(MOST_FOLDS):
        cosines, edges, owners = _folds(mesh)
        if not len(cosines) or cosines.min() >= least:
            break
        worst = int(cosines.argmin())
        mended = _mended(mesh, edges[worst], owners[worst])
        if mended is None or _sharpest(mended) <= cosines[worst]:
            break
        mesh = mended
    return mesh


def _mended(mesh: Mesh, edge: Int[np.ndarray, "2"], owners: Int[np.ndarray, "2"]) -> Mesh | None:
    """The mesh without a fold at an edge, as closed as before; None where neither of two ways is open.

    An end on three faces is taken out, and one face fills their place. Elsewhere the other diagonal of the two faces
    replaces the edge, unless that is an edge already.
    """
    for end in edge:
        around = np.flatnonzero((mesh.faces == end).any(axis=1))
        if len(around) == 3:
            return _without(mesh, int(end), around)
    opposite = [int(np.setdiff1d(face, edge)[0]) for face in mesh.faces[owners]]
    if any(opposite[1] in face for face in mesh.faces[(mesh.faces == opposite[0]).any(axis=1)]):
        return None
    faces = mesh.faces.copy()
    for row, (old, new) in zip(owners, zip(edge, opposite[::-1], strict=True), strict=True):
        faces[row] = np.where(faces[row] == old, new, faces[row])
    return _with_scalars(mesh, mesh.vertices, faces)


def _without(mesh: Mesh, vertex: int, around: Int[np.ndarray, "3"]) -> Mesh:
    """The mesh without a vertex on three faces."""
    first = mesh.faces[around[0]]
    filling = np.where(first == vertex, np.setdiff1d(mesh.faces[around], first)[0], first)
    faces = np.concatenate([np.delete(mesh.faces, around, axis=0), filling[None]])
    vertices = np.delete(mesh.vertices, vertex, axis=0)
    return _with_scalars(mesh, vertices, faces - (faces > vertex))


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
    cosines, _, _ = _folds(mesh)
    return float(cosines.min()) if len(cosines) else -1.0


def _folds(mesh: Mesh) -> tuple[Float[np.ndarray, "e"], Int[np.ndarray, "e 2"], Int[np.ndarray, "e 2"]]:
    """Cosines between the normals of neighbouring faces, -1 where one has no area, with edges and both faces.

    Of a mesh that is not closed, none.
    """
    tri = mesh.vertices[mesh.faces]
    normals = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    length = np.linalg.norm(normals, axis=1)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    if len(edges) % 2:
        return np.zeros(0), np.zeros((0, 2), int), np.zeros((0, 2), int)
    owners = (np.arange(len(edges)) // 3)[order].reshape(-1, 2)
    area = length[owners].prod(axis=1)
    dot = np.einsum("ij,ij->i", normals[owners[:, 0]], normals[owners[:, 1]])
    cosines = np.divide(dot, area, out=np.full(len(area), -1.0), where=area > 0)
    return cosines, edges[order[::2]], owners


def _with_scalars(mesh: Mesh, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Mesh:
    nearest = cKDTree(mesh.vertices).query(vertices)[1] if len(vertices) else np.zeros(0, int)
    scalars = {name: values[nearest] for name, values in mesh.scalars.items()}
    return Mesh(vertices, faces, vertex_normals(vertices, faces), scalars)
