"""Marching cubes in some cells of a large grid.

The cells go in blocks to scikit-image's implementation (Lewiner et al., Efficient implementation of marching cubes'
cases with topological guarantees, 2003), which decides a face by the values at its corners alone, so that blocks agree
on the faces they share. Vertices are numbered by the edge of the grid that they lie on, and so welded exactly.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from skimage import measure

from model.inference.lattice import CORNERS, Nodes, corners_of

#: Cells along each axis of a block, as a power of two.
BLOCK_BITS = 5
#: Node values beside the surface, in shares of their median, count as no smaller than the first and no larger than the
#: second: a vertex exactly on a node would make degenerate faces, and belong to several edges.
CLEARANCE, CEILING = 1e-3, 100.0
#: Number of the edges of vertices inside a cell.
INTERIOR = 3
#: Corners of a cell's faces: two that are opposite each other, then the two others.
_FACES: Int[np.ndarray, "6 4"] = np.array(
    [[0, 3, 1, 2], [4, 7, 5, 6], [0, 5, 1, 4], [2, 7, 3, 6], [0, 6, 2, 4], [1, 7, 3, 5]]
)


@dataclass(frozen=True)
class Polygons:
    """Triangles whose vertices lie on edges of a grid, in grid steps.

    Attributes:
        places: (v, 3) vertices.
        faces: (f, 3) vertex numbers, counter-clockwise seen from where the field is negative.
        starts: (v, 3) node at the lower end of each vertex' edge; first corner of the cell of an interior vertex.
        axes: (v,) axis of the edge; `INTERIOR` for a vertex inside a cell.
        ends: (v, 2) values at the ends of the edge.
    """

    places: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    starts: Int[np.ndarray, "v 3"]
    axes: Int[np.ndarray, "v"]
    ends: Float[np.ndarray, "v 2"]


def polygons_of(cells: Nodes, values: Float[np.ndarray, "n 8"]) -> Polygons:
    """Zero surface in cells whose corners are not all on one side.

    Args:
        cells: their first corners.
        values: at the corners, in the order of `model.inference.lattice.CORNERS`; zero counts as outside.
    """
    cleared, typical = _cleared(values)
    parts = [_polygons_of_block(cells[few], cleared[few]) for few in _blocks(cells)]
    sizes = np.cumsum([0, *(len(part.places) for part in parts)])
    faces = np.concatenate([part.faces + size for part, size in zip(parts, sizes[:-1], strict=True)])
    starts, axes = (np.concatenate([getattr(part, name) for part in parts]) for name in ("starts", "axes"))
    first = starts.min(axis=0)
    span = tuple(starts.max(axis=0) - first + 1)
    number = np.ravel_multi_index(tuple((starts - first).T), span) * 4 + axes
    _, pick, inverse = np.unique(number, return_index=True, return_inverse=True)
    places, ends = (np.concatenate([getattr(part, name) for part in parts])[pick] for name in ("places", "ends"))
    return Polygons(places, inverse[faces], starts[pick], axes[pick], typical * ends)


def checkered_nodes(cells: Nodes, values: Float[np.ndarray, "n 8"]) -> Nodes:
    """Of each face whose signs make a checkerboard, the negative corner that is closer to zero.

    Where two cells meet in such a face, marching cubes can join four triangles in one edge; this happens in noise
    at the scale of the grid. With these nodes positive, and the same done again until there are none, it cannot.
    """
    found = [cells[:0]]
    for face in _FACES:
        for pair in (face, face[[2, 3, 0, 1]]):
            corners = values[:, pair]
            checkered = (corners[:, :2] <= 0).all(axis=1) & (corners[:, 2:] > 0).all(axis=1)
            closer = pair[np.argmax(corners[checkered, :2], axis=1)]
            found.append(cells[checkered] + CORNERS[closer])
    return np.unique(np.concatenate(found), axis=0)


def _blocks(cells: Nodes) -> Iterator[Int[np.ndarray, "m"]]:
    """Numbers of the cells of each block."""
    block = cells >> BLOCK_BITS
    block -= block.min(axis=0)
    number = np.ravel_multi_index(tuple(block.T), tuple(block.max(axis=0) + 1))
    order = np.argsort(number, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(number[order])) + 1)


def _polygons_of_block(cells: Nodes, values: Float[np.ndarray, "n 8"]) -> Polygons:
    first = cells.min(axis=0)
    local = cells - first
    volume = np.ones(local.max(axis=0) + 2, np.float32)
    volume[tuple(corners_of(local).T)] = values.ravel()
    mask: Bool[np.ndarray, "i j k"] = np.zeros(volume.shape, bool)
    mask[tuple((local + 1).T)] = True  # scikit-image counts a cell by its last corner
    marching_cubes: Any = measure.marching_cubes
    places, faces, _, _ = marching_cubes(volume, 0.0, method="lewiner", gradient_direction="ascent", mask=mask)
    starts = np.floor(places).astype(np.int64)
    fractional = places != starts
    axes = np.where(fractional.sum(axis=1) == 1, np.argmax(fractional, axis=1), INTERIOR)
    stop = starts + np.concatenate([np.eye(3, dtype=np.int64), np.zeros((1, 3), np.int64)])[axes]
    ends = np.stack([volume[tuple(starts.T)], volume[tuple(stop.T)]], axis=1)
    return Polygons(places + first.astype(float), faces.astype(np.int64), starts + first, axes, ends)


def _cleared(values: Float[np.ndarray, "n 8"]) -> tuple[Float[np.ndarray, "n 8"], float]:
    """Values in units of their typical size, moved away from zero, signs kept (zero counts as outside); that size."""
    size = np.abs(values)
    typical = max(float(np.median(size)), 1e-30)
    size = np.clip(size / np.float32(typical), CLEARANCE, CEILING)
    return np.where(values > 0, size, -size).astype(np.float32), typical
