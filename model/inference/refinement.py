"""Values of a scalar field on a grid that gets finer where the zero surface can be; knows no network.

Multiresolution isosurface extraction: `Refinement` asks for points (`query`), takes their values (`update`)
and in the end gives the dense grid (`grid`) (Mescheder et al., Occupancy Networks, 2019).
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from model.errors import InvalidParameter

#: How far from a cell's corners the surface is looked for without a sign change, in cell sizes: everywhere
#: (half a diagonal), in the last step only as far as spares a round of following the surface.
COARSE_REACH = 3**0.5 / 2
FINEST_REACH = 0.3


class Refinement:
    """Values of a field on a grid that is refined where the zero surface can be.

    Starts with every ``coarse_factor``-th node. Each level halves the step in the cells that hold a
    sign change, in their neighbours on the coarsest level, and in those whose values are so small,
    compared with the slopes around them, that the surface could pass between the corners, as it does
    where a part is thinner than a cell. When the finer nodes on the border of the refined region show
    a sign change, the cells beyond are refined too, until the surface is closed. Other nodes are
    interpolated, which keeps their sign.

    Args:
        lower, upper: corners of the box (mm).
        step_mm: distance of the finest nodes; the first is at `lower`, the last at or just past `upper`.
        coarse_factor: coarsest step in finest steps, a power of two.
    """

    def __init__(
        self, lower: Float[np.ndarray, "3"], upper: Float[np.ndarray, "3"], step_mm: float, coarse_factor: int = 4
    ) -> None:
        _check(lower, upper, step_mm, coarse_factor)
        self._origin = np.asarray(lower, float)
        self._step = step_mm
        self._cells = np.maximum(np.ceil((np.asarray(upper, float) - lower) / step_mm - 1e-6), 1).astype(int)
        self._stride = coarse_factor
        self._values: Float[np.ndarray, "i j k"] = np.zeros(-(-self._cells // coarse_factor) + 1, np.float32)
        self._known = np.zeros(self._values.shape, bool)
        self._pending = ~self._known
        self._refined: Bool[np.ndarray, "a b c"] | None = None
        self._floods = 0
        self.evaluations = 0

    def query(self) -> Float[np.ndarray, "n 3"]:
        """The points (mm) whose values are wanted next; none when the grid is complete."""
        return np.asarray(self._origin + np.argwhere(self._pending) * (self._step * self._stride))

    def update(self, values: Float[np.ndarray, "n"]) -> None:
        """Take the values at the points of the last `query`."""
        self._values[self._pending] = values
        self._known |= self._pending
        self.evaluations += len(values)
        self._pending = self._leaks()
        while not self._pending.any() and self._stride > 1:
            self._refine()

    def grid(self) -> Float[np.ndarray, "i j k"]:
        """All values on the finest nodes, evaluated or interpolated."""
        i, j, k = self._cells + 1
        return self._values[:i, :j, :k]

    def _leaks(self) -> Bool[np.ndarray, "i j k"]:
        """Unknown nodes of cells beyond the refined ones into which the surface runs."""
        if self._refined is None:
            return np.zeros_like(self._known)
        beyond = mixed_cells(self._values > 0, 2) & ~self._refined
        if not beyond.any():
            return np.zeros_like(self._known)
        self._floods += 1
        if self._floods > 1:
            beyond = ndimage.binary_dilation(beyond, np.ones((3, 3, 3), bool))
        self._refined |= beyond
        return _nodes_of(beyond) & ~self._known

    def _refine(self) -> None:
        """Halve the step."""
        cells, coarsest = mixed_cells(self._values > 0, 1), self._refined is None
        if coarsest:
            cells = ndimage.binary_dilation(cells, np.ones((3, 3, 3), bool))
        reach = FINEST_REACH if self._stride == 2 and not coarsest else COARSE_REACH
        self._refined = cells | _within_reach(self._values, reach)
        self._stride //= 2
        self._floods = 0
        self._values = _prolonged(self._values)
        known = np.zeros(self._values.shape, bool)
        known[::2, ::2, ::2] = self._known
        self._known = known
        self._pending = _nodes_of(self._refined) & ~known


def mixed_cells(inside: Bool[np.ndarray, "i j k"], span: int) -> Bool[np.ndarray, "a b c"]:
    """Cells of `span` node intervals along each axis whose nodes are not all on one side."""
    some = every = inside
    for axis in range(3):
        some, every = _pooled(some, axis, span, np.logical_or), _pooled(every, axis, span, np.logical_and)
    return np.asarray(some & ~every)


def _check(lower: np.ndarray, upper: np.ndarray, step_mm: float, coarse_factor: int) -> None:
    if not (np.isfinite(step_mm) and step_mm > 0):
        raise InvalidParameter("The grid step must be a positive number of mm.", part="resolution_mm")
    if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (np.asarray(upper) > lower).all()):
        raise InvalidParameter("The box of a surface must have a finite positive size along each axis.", part="box")
    if coarse_factor < 1 or coarse_factor & (coarse_factor - 1):
        raise InvalidParameter("The coarse factor must be a power of two.", part="coarse_factor")


def _pooled(nodes: np.ndarray, axis: int, span: int, combine: np.ufunc) -> np.ndarray:
    line = np.moveaxis(nodes, axis, 0)
    result = combine(line[:-1:span], line[span::span])
    if span == 2:
        result = combine(result, line[1::2])
    return np.moveaxis(result, 0, axis)


def _nodes_of(cells: Bool[np.ndarray, "a b c"]) -> Bool[np.ndarray, "i j k"]:
    """The nodes at half the step that belong to cells, corners and middles."""
    nodes = cells
    for axis in range(3):
        line = np.moveaxis(nodes, axis, 0)
        wide = np.zeros((2 * len(line) + 1, *line.shape[1:]), bool)
        wide[1::2] = line
        wide[:-1:2] = line
        wide[2::2] |= line
        nodes = np.moveaxis(wide, 0, axis)
    return nodes


def _prolonged(values: Float[np.ndarray, "i j k"]) -> Float[np.ndarray, "a b c"]:
    """Trilinear interpolation to half the step."""
    for axis in range(3):
        line = np.moveaxis(values, axis, 0)
        wide = np.empty((2 * len(line) - 1, *line.shape[1:]), np.float32)
        wide[::2] = line
        wide[1::2] = (line[:-1] + line[1:]) / 2
        values = np.moveaxis(wide, 0, axis)
    return np.ascontiguousarray(values)


def _within_reach(values: Float[np.ndarray, "i j k"], reach: float) -> Bool[np.ndarray, "a b c"]:
    """Cells with a corner so close to zero that, with slopes like those around, the surface is within `reach`."""
    squared = np.zeros([n - 1 for n in values.shape], np.float32)
    for axis in range(3):
        slope = np.diff(values, axis=axis)
        for other in {0, 1, 2} - {axis}:
            line = np.moveaxis(slope, other, 0)
            slope = np.moveaxis((line[:-1] + line[1:]) / 2, 0, other)
        squared += slope**2
    nearest = np.abs(values)
    for axis in range(3):
        nearest = _pooled(nearest, axis, 1, np.minimum)
    return np.asarray(nearest**2 <= reach**2 * ndimage.maximum_filter(squared, 3))
