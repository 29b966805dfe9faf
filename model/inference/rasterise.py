"""Voxels whose centre lies inside a closed mesh."""

import numpy as np
from jaxtyping import Bool, Float, Int

from model.geometry import Grid
from model.inference.mesh import Mesh


def rasterise(mesh: Mesh, grid: Grid) -> Bool[np.ndarray, "i j k"]:
    """Which voxel centres lie inside a closed mesh.

    A ray runs along the last index axis through each (i, j); each face that it crosses changes the
    winding number of the voxels beyond. Rays through an edge or a corner of the projection count for
    one face only, as if the ray were moved by (e, e^2) with e infinitesimal (Edelsbrunner and Muecke,
    Simulation of Simplicity, 1990).

    Args:
        mesh: closed, world RAS mm; parts outside the grid are cut off.
        grid: voxels in the world, in any orientation, mirrored as well.
    """
    corners = grid.to_index(mesh.vertices)[mesh.faces]
    face, i, j = _columns(corners, grid.shape)
    triangles = corners[face]
    sign = _crossing_sign(triangles, mesh.faces[face], i, j)
    hit = sign != 0
    depth = _depth(triangles[hit], i[hit], j[hit])
    first = np.clip(np.ceil(depth), 0, grid.shape[2]).astype(np.int64)
    change = np.zeros((grid.shape[0], grid.shape[1], grid.shape[2] + 1), np.int32)
    np.add.at(change, (i[hit], j[hit], first), sign[hit])
    return np.asarray(np.cumsum(change, axis=2)[:, :, :-1] != 0)


def _columns(
    corners: Float[np.ndarray, "f 3 3"], shape: tuple[int, int, int]
) -> tuple[Int[np.ndarray, "c"], Int[np.ndarray, "c"], Int[np.ndarray, "c"]]:
    """Faces paired with the (i, j) inside the bounding rectangle of their projection."""
    limit = np.array(shape[:2])
    low = np.clip(np.ceil(corners[:, :, :2].min(axis=1)), 0, limit).astype(np.int64)
    high = np.clip(np.floor(corners[:, :, :2].max(axis=1)) + 1, 0, limit).astype(np.int64)
    width = np.maximum(high - low, 0)
    count = width[:, 0] * width[:, 1]
    face = np.repeat(np.arange(len(corners)), count)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    columns = np.maximum(width[face, 1], 1)
    return face, low[face, 0] + within // columns, low[face, 1] + within % columns


def _crossing_sign(
    triangles: Float[np.ndarray, "c 3 3"],
    vertices: Int[np.ndarray, "c 3"],
    i: Int[np.ndarray, "c"],
    j: Int[np.ndarray, "c"],
) -> Int[np.ndarray, "c"]:
    """+1 where a ray upwards enters through the face, -1 where it leaves, 0 where it misses."""
    left = np.stack(
        [
            _left_of(triangles[:, a, :2], triangles[:, b, :2], vertices[:, a] < vertices[:, b], i, j)
            for a, b in ((0, 1), (1, 2), (2, 0))
        ]
    )
    return np.where(left.all(axis=0), -1, np.where(left.any(axis=0), 0, 1))


def _left_of(
    start: Float[np.ndarray, "c 2"],
    end: Float[np.ndarray, "c 2"],
    forward: Bool[np.ndarray, "c"],
    i: Int[np.ndarray, "c"],
    j: Int[np.ndarray, "c"],
) -> Bool[np.ndarray, "c"]:
    """Whether (i, j) lies left of a directed edge; evaluated alike for both faces that share the edge."""
    low = np.where(forward[:, None], start, end)
    edge = np.where(forward[:, None], end, start) - low
    side = edge[:, 0] * (j - low[:, 1]) - edge[:, 1] * (i - low[:, 0])
    side = np.where(side == 0, -edge[:, 1], side)
    side = np.where(side == 0, edge[:, 0], side)
    return np.asarray((side > 0) == forward)


def _depth(
    triangles: Float[np.ndarray, "c 3 3"], i: Int[np.ndarray, "c"], j: Int[np.ndarray, "c"]
) -> Float[np.ndarray, "c"]:
    """Third index at which the ray through (i, j) crosses the plane of each triangle."""
    origin = triangles[:, 0]
    normal = np.cross(triangles[:, 1] - origin, triangles[:, 2] - origin)
    drop = normal[:, 0] * (i - origin[:, 0]) + normal[:, 1] * (j - origin[:, 1])
    flat = normal[:, 2] == 0
    depth = origin[:, 2] - drop / np.where(flat, 1.0, normal[:, 2])
    nearest, furthest = triangles[:, :, 2].min(axis=1), triangles[:, :, 2].max(axis=1)
    return np.asarray(np.clip(np.where(flat, nearest, depth), nearest, furthest))
