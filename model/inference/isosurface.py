"""The zero surface of a scalar field as a closed mesh; knows no network.

Coarse-to-fine evaluation (`model.inference.refinement`), marching cubes in the cells through which the surface runs
(`model.inference.polygons`), and a Newton step of each vertex along its edge of the grid when there is a gradient.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from model.inference.mesh import Mesh, empty_mesh, is_watertight, largest_component, mesh_of, unit
from model.inference.polygons import INTERIOR, Polygons, checkered_nodes, polygons_of
from model.inference.refinement import Field, Refinement, coarse_factor_of, completed

#: Values and their gradient (per mm).
FieldWithGradient = Callable[[Float[np.ndarray, "n 3"]], tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 3"]]]

#: Value of a node whose sign had to change.
RAISED = 1e-30
#: Vertices keep this share of an edge away from its ends.
EDGE_MARGIN = 1e-4
NEAR_END = 0.05
NEWTON_STEPS = 10


def extract_surface(
    field: Field,
    lower: Float[np.ndarray, "3"],
    upper: Float[np.ndarray, "3"],
    step_mm: float,
    *,
    coarse_factor: int | None = None,
    gradient: FieldWithGradient | None = None,
    steepest: float | None = None,
    keep_specks: bool = False,
) -> Mesh:
    """The closed surface where a field is zero, inside a box.

    Watertight, two-manifold, oriented outwards, without self-intersections: each vertex stays on its own edge of the
    grid, at most one on an edge. Where the object reaches the border of the box it is capped there (half a step
    outside). Without `gradient` the vertices are second order accurate in the step, with it fourth order. Memory and
    evaluations grow with the surface, not with the box; which parts could be missed is told in
    `model.inference.refinement`.

    Args:
        field: values at points (mm), positive inside.
        lower, upper: corners of the box (mm).
        step_mm: distance of the finest nodes.
        coarse_factor: coarsest step in finest steps, a power of two; by the size of the box when None.
        gradient: values and gradients at points; moves the vertices onto the surface and gives the normals. It is
            called once, with all vertices in their order.
        steepest: bound of the field's slope (1/mm) that the caller vouches for; none is needed.
        keep_specks: keep all components; only the one of largest volume otherwise (`largest_component`
            counts those that go).

    Returns:
        The surface in the field's coordinates; an empty mesh when the field is nowhere positive.

    Raises:
        InvalidParameter: a step, box or factor that no grid can have.
    """
    factor = coarse_factor or coarse_factor_of(lower, upper, step_mm)
    refinement = Refinement(lower, upper, step_mm, factor, steepest)
    polygons = _polygons(refinement, field)
    if polygons is None:
        return empty_mesh()
    mesh = mesh_of(lower + step_mm * polygons.places, polygons.faces)
    if gradient is not None:
        mesh = _settled(mesh, gradient, polygons, refinement, step_mm)
    return mesh if keep_specks else largest_component(mesh)[0]


def _polygons(refinement: Refinement, field: Field) -> Polygons | None:
    """Polygons of the finest grid, its values changed where they would not be two-manifold; None where it is empty."""
    cells, values = completed(refinement, field).crossed()
    if not len(cells):
        return None
    polygons = polygons_of(cells, values)
    if is_watertight(Mesh(polygons.places, polygons.faces, polygons.places)):
        return polygons
    while len(nodes := checkered_nodes(cells, values)):
        refinement.raise_nodes(nodes, RAISED)
        cells, values = completed(refinement, field).crossed()
    return polygons_of(cells, values)


def _settled(
    mesh: Mesh, gradient: FieldWithGradient, polygons: Polygons, refinement: Refinement, step_mm: float
) -> Mesh:
    """Vertices moved along their edges onto the surface; normals from the gradient. Those beyond the box stay.

    Where the gradient is taken matters for normals: at the zero of the cubic through four nodes of the edge's line.
    """
    free = np.asarray(np.all((polygons.places >= 0) & (polygons.places <= refinement.shape - 1), axis=1))
    own = np.flatnonzero(free & (polygons.axes != INTERIOR))
    axis, starts, ends = polygons.axes[own], polygons.starts[own], polygons.ends[own]
    at = polygons.places[own, axis] - starts[np.arange(len(own)), axis]
    zeros = edge_zeros(at, *_interpolated(at, ends, refinement.beyond_ends(starts, axis)), ends)
    vertices = mesh.vertices.copy()
    vertices[own, axis] += step_mm * (zeros - at)
    values, slopes = gradient(vertices)
    settled = edge_zeros(zeros, values[own].astype(float), step_mm * slopes[own, axis].astype(float), ends)
    vertices[own, axis] += step_mm * (settled - zeros)
    return replace(mesh, vertices=vertices, normals=np.where(free[:, None], -unit(slopes.astype(float)), mesh.normals))


def _interpolated(
    at: Float[np.ndarray, "v"], ends: Float[np.ndarray, "v 2"], beyond: Float[np.ndarray, "v 2"]
) -> tuple[Float[np.ndarray, "v"], Float[np.ndarray, "v"]]:
    """Value and slope of the cubic through the nodes at -1, 0, 1 and 2; of lower degree where the outer are unknown."""
    rise = ends[:, 1] - ends[:, 0]
    first, second = beyond[:, 0] - ends[:, 0] + rise, beyond[:, 1] - ends[:, 1] - rise
    first, second = (np.nan_to_num(np.where(np.isnan(a), b, a)) for a, b in ((first, second), (second, first)))
    bend, twist = first / 2.0, (second - first) / 6.0
    value = ends[:, 0] + at * (rise + (at - 1.0) * (bend + (at + 1.0) * twist))
    return value, rise + (2.0 * at - 1.0) * bend + (3.0 * at * at - 1.0) * twist


def edge_zeros(
    at: Float[np.ndarray, "v"],
    values: Float[np.ndarray, "v"],
    slopes: Float[np.ndarray, "v"],
    ends: Float[np.ndarray, "v 2"],
) -> Float[np.ndarray, "v"]:
    """Where the cubic through the ends of an edge, and through value and slope at a place on it, is zero.

    Newton's method, by bisection where it would leave the edge; the ends are of opposite signs.

    Args:
        at: places, from 0 to 1.
        values, slopes: there.
        ends: values at 0 and 1.
    """
    # An end too close to the place tells nothing of the bend; the other's parabola serves.
    start, end = ((ends[:, k] - values - slopes * (k - at)) / np.maximum(np.square(k - at), 1e-12) for k in (0, 1))
    start, end = np.where(at < NEAR_END, end, start), np.where(at > 1.0 - NEAR_END, start, end)
    cubic, square = end - start, start + (end - start) * at
    low, high = np.zeros_like(at), np.ones_like(at)
    zero = at
    for _ in range(NEWTON_STEPS):
        way = zero - at
        value = values + way * (slopes + way * (square + way * cubic))
        tilt = slopes + way * (2.0 * square + 3.0 * way * cubic)
        before = (value > 0) == (ends[:, 0] > 0)
        low, high = np.where(before, zero, low), np.where(before, high, zero)
        following = zero - np.divide(value, tilt, out=np.full_like(zero, np.inf), where=tilt != 0)
        zero = np.where((following >= low) & (following <= high), following, (low + high) / 2.0)
    return np.asarray(np.clip(zero, EDGE_MARGIN, 1.0 - EDGE_MARGIN))
