"""The zero surface of a scalar field as a closed mesh; knows no network.

Coarse-to-fine evaluation (`model.inference.refinement`), marching cubes on the dense grid (Lewiner et al.,
Efficient implementation of marching cubes' cases with topological guarantees, 2003), and a Newton step of
the vertices along the field's gradient when there is one.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from skimage import measure

from model.inference.mesh import Mesh, empty_mesh, is_watertight, largest_component, mesh_of, unit
from model.inference.refinement import Refinement, mixed_cells

#: Positive inside, negative outside; points in mm.
Field = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]]
#: Values and their gradient (per mm).
FieldWithGradient = Callable[[Float[np.ndarray, "n 3"]], tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]]

#: Node values this close to zero, in shares of the typical value beside the surface, count as that
#: far away: a vertex exactly on a node would make degenerate faces.
NODE_CLEARANCE = 1e-3
#: The coarsest grid has at least this many cells along each axis, so that no limb of an object is lost.
COARSE_CELLS = 12


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
    near = np.abs(values[:-1, :-1, :-1][mixed_cells(values > 0, 1)]) if min(values.shape) > 1 else np.abs(values)
    clearance = np.float32(NODE_CLEARANCE * max(float(np.median(near)) if near.size else 0.0, 1e-30))
    return np.where(np.abs(values) < clearance, np.where(values > 0, clearance, -clearance), values)
