"""Pairs of triangles of a mesh that pierce each other, found without the code that made the mesh."""

import numpy as np
from scipy.spatial import cKDTree

from model.inference.mesh import Mesh

#: Determinants below this share of the product of their columns' lengths are zero but for rounding.
ROUNDING = 1e-13


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
    size = np.linalg.norm(way, axis=1) * np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1)
    scale = np.where(np.abs(det) <= ROUNDING * size, np.nan, det)
    s = origin - a
    u = np.einsum("ij,ij->i", s, h) / scale
    q = np.cross(s, b - a)
    v = np.einsum("ij,ij->i", way, q) / scale
    t = np.einsum("ij,ij->i", c - a, q) / scale
    return apart & (u > 0) & (v > 0) & (u + v < 1) & (t > 0) & (t < 1)


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
