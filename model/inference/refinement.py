"""Values of a scalar field on a grid that gets finer where the zero surface can be; knows no network.

Multiresolution isosurface extraction (Mescheder et al., Occupancy Networks, 2019): `Refinement` asks for points
(`query`), takes their values (`update`) and in the end gives the cells through which the surface runs (`crossed`).
Only nodes near the surface are held, in `model.inference.lattice`.

Which cells may be left out. In a cell of size ``s`` let ``T`` be the trilinear interpolant of the field ``f`` at the
corners. If ``|f - T| <= E`` there, and the corners of one of the cell's eighths are of one sign and further than ``E``
from zero in ``T``, then ``f`` has no zero in that eighth, for ``T`` takes its extremes at corners. Two bounds are used:

- With a slope ``|grad f| <= L`` that the caller vouches for: ``|f(x) - T(x)| <= sum_c w_c(x) L |x - c|``, with the
  interpolation's weights ``w_c``. The sum is largest in the middle of the cell, so ``E = sqrt(3) / 2 * s * L``. Then no
  node of the finest grid can have another sign than the field: a proof.
- Measured: for a twice differentiable field ``|f - T| <= s^2 / 8 sum_i max |f_ii|``. The second derivatives are taken
  from second differences ``D_i`` at the corners, and ``E = KINK / 8 * sum_i max |D_i|``. For a smooth field that is
  four times the bound. For a field with a kink, such as the distance to a plate, a needle or a ball thinner than
  the cell (where ``f`` rises to a ridge between the corners and falls again, with equal slopes), four times is what
  is needed: a plate half-way between two nodes has ``|D| = s L``, and its ridge stands ``s L / 2`` above ``T``.

The second fails where a field gives no sign of what is between its nodes: flat except close to a part that is
thinner than a coarse cell and connected to nothing, or parts that repeat at the period of the coarsest cells. What is
connected is followed, whatever its slopes.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from model.errors import InvalidParameter
from model.inference.lattice import CORNERS, Nodes, SparseLattice, corners_of

#: Positive inside, negative outside; points in mm.
Field = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]]

#: The coarsest grid has at least this many cells along each axis.
COARSE_CELLS = 5
FACTORS = (2, 4, 8, 16, 32)
#: Share of the interpolation error's bound by second differences that a ridge between two nodes can reach.
KINK = 4.0
#: Weights of a cell's corners in the corners of its eighths: (eighth, corner of the eighth, corner).
_HALVES: Float[np.ndarray, "8 8 8"] = np.prod(
    1.0 - np.abs((CORNERS[:, None] + CORNERS[None])[:, :, None] / 2.0 - CORNERS), axis=-1, dtype=np.float32
)
#: Bits of the corners on each face: (axis, side).
_FACE_BITS: UInt8[np.ndarray, "3 2"] = np.packbits(
    [[CORNERS[:, k] == side for side in (0, 1)] for k in range(3)], axis=2
)[:, :, 0]
_AXES: Int[np.ndarray, "3 3"] = np.eye(3, dtype=np.int64)


class Refinement:
    """Values of a field on a grid that is refined where the zero surface can be (see the module).

    Starts with every ``coarse_factor``-th node; each level halves the step in the cells that cannot be left
    out. When a face of a cell shows a sign change, the cell beyond is looked at too, until the surface is closed or
    meets the border of the box; there, cells with a positive corner on the border belong to it.

    Args:
        lower, upper: corners of the box (mm).
        step_mm: distance of the finest nodes; the first is at `lower`, the last at or just past `upper`.
        coarse_factor: coarsest step in finest steps, a power of two.
        steepest: bound of the field's slope (1/mm), where the caller has one; by second differences when None.
    """

    def __init__(
        self,
        lower: Float[np.ndarray, "3"],
        upper: Float[np.ndarray, "3"],
        step_mm: float,
        coarse_factor: int = 4,
        steepest: float | None = None,
    ) -> None:
        _check(lower, upper, step_mm, coarse_factor)
        self._origin = np.asarray(lower, float)
        self._step = step_mm
        self._steepest = steepest
        self._cells = np.maximum(np.ceil((np.asarray(upper, float) - lower) / step_mm - 1e-6), 1).astype(np.int64)
        self._stride = coarse_factor
        self._lattice = SparseLattice(self._counts() + 1)
        self._fresh = self._lattice.add_cells(_all_nodes(self._counts()))
        self._pending = self._lattice.unknown_corners(self._fresh)
        self.evaluations = 0

    @property
    def shape(self) -> Int[np.ndarray, "3"]:
        """Nodes of the finest grid along each axis."""
        return np.asarray(self._cells + 1)

    def query(self) -> Float[np.ndarray, "n 3"]:
        """The points (mm) whose values are wanted next; none when the surface is closed."""
        return np.asarray(self._origin + self.wanted() * float(self._step))

    def wanted(self) -> Nodes:
        """The same as nodes of the finest grid; some may lie past its end."""
        return np.asarray(self._pending * self._stride)

    def update(self, values: Float[np.ndarray, "n"]) -> None:
        """Take the values at the points of the last `query`."""
        self._lattice.put(self._pending, values.astype(np.float32))
        self.evaluations += len(values)
        self._pending = self._pending[:0]
        self._follow()
        while not len(self._pending) and self._stride > 1:
            self._refine()

    def crossed(self) -> tuple[Nodes, Float[np.ndarray, "n 8"]]:
        """Cells of the finest grid whose corners are not all on one side, and the values at their corners.

        The grid has one more layer on each side: cells ``-1`` and ``shape - 1``, in whose outer corners the field
        is negative, so that the surface is closed at the border of the box.
        """
        cells = self._lattice.cells()
        values = self._lattice.corner_values(cells)
        outer = self._outer(cells)
        mixed = _mixed(values)
        return np.concatenate([cells[mixed], outer]), np.concatenate([values[:, mixed].T, self._padded(outer)])

    def known(self) -> tuple[Nodes, Float[np.ndarray, "n"]]:
        """Nodes of the finest grid that have values: all around cells through which the surface may run."""
        return self._lattice.known()

    def beyond_ends(self, starts: Nodes, axes: Int[np.ndarray, "v"]) -> Float[np.ndarray, "v 2"]:
        """Values at the nodes of the finest grid before and behind edges on their own lines; NaN where unknown.

        Args:
            starts: lower ends of the edges.
            axes: of the edges.
        """
        nodes = starts[:, None] + np.array([-1, 2])[:, None] * _AXES[axes][:, None]
        return np.asarray(self._lattice.values(nodes.reshape(-1, 3)).reshape(-1, 2).astype(float))

    def raise_nodes(self, nodes: Nodes, value: float) -> None:
        """Give nodes of the finest grid another value; the cells around them may then ask for theirs."""
        self._lattice.put(nodes, np.full(len(nodes), value, np.float32))
        around = self._within((nodes[:, None] - CORNERS).reshape(-1, 3))
        self._lattice.add_cells(around)
        self._fresh = np.unique(around, axis=0)
        self._pending = self._lattice.unknown_corners(self._fresh)
        self._follow()

    def _counts(self) -> Int[np.ndarray, "3"]:
        return np.asarray(-(-self._cells // self._stride))

    def _within(self, cells: Nodes) -> Nodes:
        first, last = np.zeros(3, np.int64), self._counts() - 1
        inside = [(cells[:, axis] >= first[axis]) & (cells[:, axis] <= last[axis]) for axis in range(3)]
        return np.asarray(cells[inside[0] & inside[1] & inside[2]])

    def _follow(self) -> None:
        """Put to use the cells into which the surface runs, until values are missing."""
        while len(self._fresh) and not len(self._pending):
            self._fresh = self._lattice.add_cells(self._within(self._beyond(self._fresh)))
            self._pending = self._lattice.unknown_corners(self._fresh)

    def _beyond(self, cells: Nodes) -> Nodes:
        """Neighbours across faces with a sign change, and along the border of the box where the field is positive."""
        signs = _signs(self._lattice.corner_values(cells))
        last = self._counts() - 1
        found = [cells[:0]]
        for axis in range(3):
            for side in (0, 1):
                face = signs & _FACE_BITS[axis, side]
                found.append(cells[(face > 0) & (face < _FACE_BITS[axis, side])] + (2 * side - 1) * _AXES[axis])
                border = cells[(face > 0) & (cells[:, axis] == last[axis] * side)]
                found += [border + way * _AXES[other] for other in {0, 1, 2} - {axis} for way in (-1, 1)]
        return np.concatenate(found)

    def _refine(self) -> None:
        """Halve the step."""
        cells = self._lattice.cells()
        values = self._lattice.corner_values(cells)
        error = self._errors(cells)
        eighths = (_HALVES.reshape(64, 8) @ values).reshape(8, 8, -1)
        outside, inside = eighths.min(axis=1) <= error, eighths.max(axis=1) >= -error
        self._stride //= 2
        kept = [self._children(cells, k, outside[k] & inside[k], inside[k]) for k in range(8)]
        parents, self._lattice = self._lattice, SparseLattice(self._counts() + 1)
        self._fresh = self._lattice.add_cells(np.concatenate(kept))
        self._inherit(parents)
        self._pending = self._lattice.unknown_corners(self._fresh)
        self._follow()

    def _children(self, cells: Nodes, number: int, near: Bool[np.ndarray, "n"], inside: Bool[np.ndarray, "n"]) -> Nodes:
        """One eighth of each cell, where the surface may run in it or the object meets the border of the box there."""
        found = [2 * cells[near] + CORNERS[number]]
        for axis in range(3):
            child = 2 * cells[:, axis] + CORNERS[number, axis]
            border = (child == 0) | (child >= self._counts()[axis] - 1)
            found.append(2 * cells[border & inside & ~near] + CORNERS[number])
        return self._within(np.concatenate(found))

    def _inherit(self, parents: SparseLattice) -> None:
        """Take over the values of nodes that the coarser grid had."""
        nodes = self._lattice.unknown_corners(self._fresh)
        shared = nodes[~np.any(nodes & 1, axis=1)]
        values = parents.values(shared >> 1)
        known = ~np.isnan(values)
        self._lattice.put(shared[known], values[known])

    def _errors(self, cells: Nodes) -> Float[np.ndarray, "n"]:
        """Bound of the interpolation's error in each cell."""
        if self._steepest is not None:
            return np.full(len(cells), 3**0.5 / 2 * self._stride * self._step * self._steepest, np.float32)
        bends = [self._bend(cells, axis) for axis in range(3)]
        return np.asarray(np.float32(KINK / 8.0) * (bends[0] + bends[1] + bends[2]))

    def _bend(self, cells: Nodes, axis: int) -> Float[np.ndarray, "n"]:
        """Largest second difference along an axis at the corners; infinite where no neighbour is known."""
        offsets = [(-1, 0, 1, 2) if other == axis else (0, 1) for other in range(3)]
        values = np.moveaxis(self._lattice.around(cells, *offsets), axis, 0)
        bends = np.abs(values[:2] - 2.0 * values[1:3] + values[2:])
        largest = np.fmax.reduce(bends.reshape(8, -1))
        return np.asarray(np.where(np.isnan(largest), np.float32(np.inf), largest))

    def _outer(self, cells: Nodes) -> Nodes:
        """Cells beyond the border that have a positive corner on it."""
        border = cells[np.any((cells == 0) | (cells == self._cells - 1), axis=1)]
        nodes = corners_of(border)
        nodes = nodes[np.any((nodes == 0) | (nodes == self._cells), axis=1)]
        nodes = np.unique(nodes[self._lattice.values(nodes) > 0], axis=0)
        around = np.unique((nodes[:, None] - CORNERS).reshape(-1, 3), axis=0)
        return around[np.any((around < 0) | (around >= self._cells), axis=1)]

    def _padded(self, cells: Nodes) -> Float[np.ndarray, "n 8"]:
        """Values at the corners of cells beyond the border."""
        nodes = corners_of(cells)
        values = self._lattice.values(np.clip(nodes, 0, self._cells))
        outside = np.any((nodes < 0) | (nodes > self._cells), axis=1)
        return np.where(outside, -np.abs(values), values).reshape(-1, 8)


def completed(refinement: Refinement, field: Field) -> Refinement:
    """The refinement with all values that it asks for."""
    while len(points := refinement.query()):
        refinement.update(field(points))
    return refinement


def coarse_factor_of(lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], step_mm: float) -> int:
    """The largest power of two that leaves `COARSE_CELLS` cells along the shortest axis of a box."""
    cells = float(np.min(np.asarray(upper) - lower)) / step_mm if step_mm > 0 else 0.0
    return max((factor for factor in FACTORS if cells >= COARSE_CELLS * factor), default=1)


def _signs(values: Float[np.ndarray, "8 n"]) -> UInt8[np.ndarray, "n"]:
    """Positive corners as bits."""
    return np.asarray(np.packbits(values > 0, axis=0)[0])


def _mixed(values: Float[np.ndarray, "8 n"]) -> Bool[np.ndarray, "n"]:
    signs = _signs(values)
    return np.asarray((signs > 0) & (signs < 255))


def _all_nodes(counts: Int[np.ndarray, "3"]) -> Nodes:
    return np.stack(np.unravel_index(np.arange(int(np.prod(counts))), tuple(counts)), axis=1)


def _check(lower: np.ndarray, upper: np.ndarray, step_mm: float, coarse_factor: int) -> None:
    if not (np.isfinite(step_mm) and step_mm > 0):
        raise InvalidParameter("The grid step must be a positive number of mm.", part="resolution_mm")
    if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (np.asarray(upper) > lower).all()):
        raise InvalidParameter("The box of a surface must have a finite positive size along each axis.", part="box")
    if coarse_factor < 1 or coarse_factor & (coarse_factor - 1):
        raise InvalidParameter("The coarse factor must be a power of two.", part="coarse_factor")
