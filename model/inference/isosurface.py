"""Coarse-to-fine evaluation of a scalar field and its zero surface; knows no network.

`Refinement` holds values on a grid that gets finer where the surface can be: it asks for points
(`query`), takes their values (`update`) and in the end gives the dense grid (`grid`), in the way of
multiresolution isosurface extraction (Mescheder et al., Occupancy Networks, 2019). The surface is
then marching cubes (Lewiner et al., 2003) on that grid, its vertices moved onto the field's zero by
a Newton step along the gradient when there is one.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from skimage import measure

from model.errors import InvalidParameter
from model.inference.mesh import Mesh, empty_mesh, is_watertight, largest_component, mesh_of, unit

#: Positive inside, negative outside; points in mm.
Field = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]]
#: Values and their gradient (per mm).
FieldWithGradient = Callable[[Float[np.ndarray, "n 3"]], tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]]

#: Node values this close to zero, in shares of the typical value beside the surface, count as that
#: far away: a vertex exactly on a node would make degenerate faces.
NODE_CLEARANCE = 1e-3
#: The coarsest grid has at least this many cells along each axis, so that no limb of an object is lost.
COARSE_CELLS = 12
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
        beyond = _mixed(self._values > 0, 2) & ~self._refined
        if not beyond.any():
            return np.zeros_like(self._known)
        self._floods += 1
        if self._floods > 1:
            beyond = ndimage.binary_dilation(beyond, np.ones((3, 3, 3), bool))
        self._refined |= beyond
        return _nodes_of(beyond) & ~self._known

    def _refine(self) -> None:
        """Halve the step."""
        cells, coarsest = _mixed(self._values > 0, 1), self._refined is None
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


def extract_surface(
    field: Field,
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
    step_mm: float,
    *,
    coarse_factor: int | None = None,
    gradient: FieldWithGradient | None = None,
    keep_specks: bool = False,
) -> Mesh:
    """The closed surface where a field is zero, inside a box.

    Watertight, two-manifold and oriented outwards. Where the object reaches the border of the box it
    is capped there (half a step outside). Without `gradient` the vertices are second order accurate in the
    step, with it fourth order.

    Args:
        field: values at points (mm), positive inside.
        lower, upper: corners of the box (mm).
        step_mm: distance of the finest nodes.
        coarse_factor: coarsest step in finest steps, a power of two; by the size of the box when None.
        gradient: values and gradients at points; moves the vertices onto the surface and gives the normals.
        keep_specks: keep all components; only the one of largest volume otherwise (`largest_component`
            counts those that go).

    Returns:
        The surface in the field's coordinates; an empty mesh when the field is nowhere positive.

    Raises:
        InvalidParameter: a step, box or factor that no grid can have.
    """
    refinement = Refinement(lower, upper, step_mm, coarse_factor or _coarse_factor(lower, upper, step_mm))
    while len(points := refinement.query()):
        refinement.update(field(points))
    mesh = polygonise(refinement.grid(), lower, step_mm)
    if not keep_specks:
        mesh, _ = largest_component(mesh)
    if gradient is None or mesh.is_empty:
        return mesh
    reach = refinement.grid().shape
    return _settled(mesh, gradient, lower, lower + (np.array(reach) - 1) * step_mm, step_mm)


def polygonise(values: Float[np.ndarray, "i j k"], lower: Float[np.ndarray, "3"], step_mm: float) -> Mesh:
    """Zero surface of a dense grid, positive inside, capped half a step outside the border.

    Args:
        values: at nodes ``lower + step_mm * (i, j, k)``.
    """
    inside = values > 0
    if not inside.any():
        return empty_mesh()
    first, last = _bounds(inside)
    crop = values[tuple(slice(a, b) for a, b in zip(first, last, strict=True))]
    padded = np.pad(_cleared(crop), 1, mode="edge")
    for axis in range(3):
        border = np.moveaxis(padded, axis, 0)
        border[[0, -1]] = -np.abs(border[[0, -1]])
    origin = np.asarray(lower, float) + (first - 1) * step_mm
    mesh = _marching_cubes(padded, origin, step_mm)
    if not is_watertight(mesh):
        _bridge(padded)
        mesh = _marching_cubes(padded, origin, step_mm)
    return mesh


def _marching_cubes(values: Float[np.ndarray, "i j k"], origin: Float[np.ndarray, "3"], step_mm: float) -> Mesh:
    marching_cubes: Any = measure.marching_cubes
    corners, faces, _, _ = marching_cubes(values, 0.0, method="lewiner", gradient_direction="ascent")
    return mesh_of(origin + corners.astype(float) * step_mm, faces.astype(np.int64))


def _settled(
    mesh: Mesh,
    gradient: FieldWithGradient,
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
    step_mm: float,
) -> Mesh:
    """One Newton step of each vertex along the gradient, at most half a grid step; normals from the gradient."""
    values, slopes = gradient(mesh.vertices)
    steepness = np.sum(slopes * slopes, axis=1)
    free = (steepness > 0) & ((mesh.vertices >= lower) & (mesh.vertices <= upper)).all(axis=1)
    size = np.divide(-values, np.sqrt(steepness), out=np.zeros(len(values)), where=free)
    uphill = unit(slopes.astype(float))
    vertices = mesh.vertices + np.clip(size, -step_mm / 2, step_mm / 2)[:, None] * uphill
    return replace(mesh, vertices=vertices, normals=np.where(free[:, None], -uphill, mesh.normals))


def _coarse_factor(lower: np.ndarray, upper: np.ndarray, step_mm: float) -> int:
    """The largest of 1, 2, 4, 8 that leaves `COARSE_CELLS` cells along the shortest axis of the box."""
    cells = float(np.min(upper - lower)) / step_mm if step_mm > 0 else 0.0
    return max((factor for factor in (2, 4, 8) if cells >= COARSE_CELLS * factor), default=1)


def _check(lower: np.ndarray, upper: np.ndarray, step_mm: float, coarse_factor: int) -> None:
    if not (np.isfinite(step_mm) and step_mm > 0):
        raise InvalidParameter("The grid step must be a positive number of mm.", part="resolution_mm")
    if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (np.asarray(upper) > lower).all()):
        raise InvalidParameter("The box of a surface must have a finite positive size along each axis.", part="box")
    if coarse_factor < 1 or coarse_factor & (coarse_factor - 1):
        raise InvalidParameter("The coarse factor must be a power of two.", part="coarse_factor")


def _mixed(inside: Bool[np.ndarray, "i j k"], span: int) -> Bool[np.ndarray, "a b c"]:
    """Cells of `span` node intervals along each axis whose nodes are not all on one side."""
    some = every = inside
    for axis in range(3):
        some, every = _pooled(some, axis, span, np.logical_or), _pooled(every, axis, span, np.logical_and)
    return np.asarray(some & ~every)


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


def _bounds(inside: Bool[np.ndarray, "i j k"]) -> tuple[np.ndarray, np.ndarray]:
    """First and one past the last node of a box that holds the inside and one node more on each side."""
    first, last = [], []
    for axis in range(3):
        occupied = np.flatnonzero(inside.any(axis=tuple({0, 1, 2} - {axis})))
        first.append(max(occupied[0] - 1, 0))
        last.append(min(occupied[-1] + 2, inside.shape[axis]))
    return np.array(first), np.array(last)


def _bridge(values: Float[np.ndarray, "i j k"]) -> None:
    """Make node values positive, in place, until no face of a cell has its signs in a checkerboard.

    Of the two negative corners of such a face the one closer to zero changes. Where two cells meet in such
    a face, marching cubes can join four triangles in one edge; this happens in noise at the scale of the grid.
    """
    clearance = np.float32(np.abs(values).min())
    changed = True
    while changed:
        changed = False
        for first, second in ((0, 1), (0, 2), (1, 2)):
            faces = np.moveaxis(values, (first, second), (0, 1))
            for face in (faces, faces[::-1]):
                a, b, c, d = face[:-1, :-1], face[1:, 1:], face[:-1, 1:], face[1:, :-1]
                crossed = (a < 0) & (b < 0) & (c > 0) & (d > 0)
                changed = changed or bool(crossed.any())
                closer = a >= b
                a[crossed & closer] = clearance
                b[crossed & ~closer] = clearance


def _cleared(values: Float[np.ndarray, "i j k"]) -> Float[np.ndarray, "i j k"]:
    """Values moved away from zero by `NODE_CLEARANCE`, signs kept (zero counts as outside)."""
    near = np.abs(values[:-1, :-1, :-1][_mixed(values > 0, 1)]) if min(values.shape) > 1 else np.abs(values)
    clearance = np.float32(NODE_CLEARANCE * max(float(np.median(near)) if near.size else 0.0, 1e-30))
    return np.where(np.abs(values) < clearance, np.where(values > 0, clearance, -clearance), values)
