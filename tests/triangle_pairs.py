"""Pairs of triangles of a mesh that pierce each other, found without the code that made the mesh."""

from fractions import Fraction

import numpy as np
from scipy.spatial import cKDTree

from model.inference.mesh import Mesh


def intersecting_pairs(mesh: Mesh) -> int:
    """How many pairs of faces have an edge of one through the inside of the other, or lie on each other.

    Neighbours may touch in what they share.
    """
    corners = mesh.vertices[mesh.faces]
    centres = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    pairs = cKDTree(centres).query_pairs(2.0 * reach.max(), output_type="ndarray")
    distance = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
    pairs = pairs[distance <= reach[pairs].sum(axis=1)]
    first, second = corners[pairs[:, 0]], corners[pairs[:, 1]]
    overlap = (first.min(axis=1) <= second.max(axis=1)).all(axis=1) & (second.min(axis=1) <= first.max(axis=1)).all(
        axis=1
    )
    pairs = pairs[overlap]
    bad = np.zeros(len(pairs), bool)
    for one, other in (pairs.T, pairs.T[::-1]):
        for start, end in ((0, 1), (1, 2), (2, 0)):
            bad |= _pierced(mesh, mesh.faces[one, start], mesh.faces[one, end], other)
    return int((bad | _folded(mesh, *pairs.T)).sum())


def _pierced(mesh: Mesh, start: np.ndarray, end: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Whether segments go through faces of which they hold no corner (Möller and Trumbore, 1997)."""
    faces = mesh.faces[face]
    apart = ~((faces == start[:, None]) | (faces == end[:, None])).any(axis=1)
    origin, way = mesh.vertices[start], mesh.vertices[end] - mesh.vertices[start]
    a, b, c = np.moveaxis(mesh.vertices[faces], 1, 0)
    h = np.cross(way, c - a)
    det = np.einsum("ij,ij->i", b - a, h)
    scale = np.where(det == 0.0, np.nan, det)
    s = origin - a
    u = np.einsum("ij,ij->i", s, h) / scale
    q = np.cross(s, b - a)
    v = np.einsum("ij,ij->i", way, q) / scale
    t = np.einsum("ij,ij->i", c - a, q) / scale
    result = np.asarray(apart & (u > 0) & (v > 0) & (u + v < 1) & (t > 0) & (t < 1))
    for row in np.flatnonzero(result):
        result[row] = _pierces(mesh.vertices[start[row]], mesh.vertices[end[row]], *mesh.vertices[faces[row]])
    return result


def _pierces(p: np.ndarray, q: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> bool:
    """The same of one segment and one face in exact arithmetic: small determinants are often rounding alone."""
    p, q, a, b, c = ([Fraction(float(value)) for value in point] for point in (p, q, a, b, c))
    sides = _volume(p, a, b, c), _volume(q, a, b, c)
    around = _volume(p, q, a, b), _volume(p, q, b, c), _volume(p, q, c, a)
    return sides[0] * sides[1] < 0 and (min(around) > 0 or max(around) < 0)


def _volume(a: list[Fraction], b: list[Fraction], c: list[Fraction], d: list[Fraction]) -> Fraction:
    """Six times the signed volume of a tetrahedron."""
    x, y, z = ([one - other for one, other in zip(corner, a, strict=True)] for corner in (b, c, d))
    return x[0] * (y[1] * z[2] - y[2] * z[1]) - x[1] * (y[0] * z[2] - y[2] * z[0]) + x[2] * (y[0] * z[1] - y[1] * z[0])


def _folded(mesh: Mesh, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Whether faces with a common edge lie on each other: opposite normals, third corners on one side."""
    shared = (mesh.faces[one][:, :, None] == mesh.faces[other][:, None]).any(axis=2)
    pair = np.flatnonzero(shared.sum(axis=1) == 2)
    own = ~shared[pair]
    apex = mesh.vertices[mesh.faces[one[pair]][own]]
    back = (mesh.faces[other[pair]][:, :, None] == mesh.faces[one[pair]][:, None]).any(axis=2)
    opposite = mesh.vertices[mesh.faces[other[pair]][~back]]
    edge = mesh.vertices[mesh.faces[one[pair]][shared[pair]].reshape(-1, 2)]
    along = edge[:, 1] - edge[:, 0]
    heights = []
    for tip in (apex, opposite):
        from_edge = tip - edge[:, 0]
        share = np.einsum("ij,ij->i", from_edge, along) / np.maximum(np.einsum("ij,ij->i", along, along), 1e-30)
        height = from_edge - share[:, None] * along
        heights.append(height / np.maximum(np.linalg.norm(height, axis=1, keepdims=True), 1e-30))
    result = np.zeros(len(one), bool)
    result[pair] = np.einsum("ij,ij->i", *heights) > 1.0 - 1e-9
    return result
