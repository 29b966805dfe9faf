"""Voxels of a grid: those in the box that a model's surface is looked for in, and those inside the surface."""

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from model.bundle import ShapeModel
from model.geometry import Grid
from model.inference.fitting import Fit
from model.inference.posterior import fitted_logits
from model.inference.refinement import Refinement, coarse_factor_of, completed
from model.inference.surface import canonical_box

#: Voxels whose positions are held at the same time, about.
SLAB = 1 << 18
#: Values at places on a grid (indices, fractions allowed), positive inside.
IndexField = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]]


def slabs_in_box(
    model: ShapeModel, found: Fit, grid: Grid
) -> Iterator[tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]]:
    """Indices and world positions (mm) of the voxels that lie in the model's canonical box, some layers at a time."""
    low, high = _range_of_box(model, found, grid)
    layers = max(1, SLAB // max(1, int(np.prod(high[1:] - low[1:]))))
    for first in range(low[0], high[0], layers):
        axes = [np.arange(first, min(first + layers, high[0])), *(np.arange(low[k], high[k]) for k in (1, 2))]
        index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        points = grid.to_world(index.astype(float))
        inside = _is_in_box(model, found, points)
        if inside.any():
            yield index[inside], points[inside]


def inside_mask(model: ShapeModel, found: Fit, grid: Grid) -> Bool[np.ndarray, "i j k"]:
    """Voxels at whose centres a fitted field is positive, of all its bodies in the model's box.

    The same as evaluating it at every voxel, but for what `model.inference.refinement` could miss: surfaces are
    extracted by the same rules.
    """
    low, high = _range_of_box(model, found, grid)

    def field(places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        return fitted_logits(model, found, grid.to_world(low + places))

    result = np.zeros(grid.shape, bool)
    if (high > low).all():
        result[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = positive_nodes(field, high - low)
        for layer in np.flatnonzero(result.any(axis=(1, 2))):
            index = np.insert(np.argwhere(result[layer]), 0, layer, axis=1)
            result[tuple(index.T)] = _is_in_box(model, found, grid.to_world(index.astype(float)))
    return result


def positive_nodes(field: IndexField, shape: Int[np.ndarray, "3"]) -> Bool[np.ndarray, "i j k"]:
    """Nodes of a grid at which a field is positive, by evaluations near its zero surface.

    An edge of the grid along which the sign changes has values at both of its ends, and so has an edge of the border
    with a positive end. So a node without a value has the sign of its neighbours, and where there are no values at
    all the field is negative.

    Args:
        field: at places between 0 and ``shape - 1``, or a coarse step beyond.
        shape: nodes along each axis.
    """
    last = np.asarray(shape, float) - 1.0
    if last.min() < 1.0:
        nodes = np.indices(tuple(shape)).reshape(3, -1).T
        return np.asarray(field(nodes.astype(float)) > 0).reshape(tuple(shape))
    refinement = completed(Refinement(np.zeros(3), last, 1.0, coarse_factor_of(np.zeros(3), last, 1.0)), field)
    nodes, values = refinement.known()
    signs = np.zeros(tuple(shape), np.int8)
    signs[tuple(nodes.T)] = np.where(values > 0, 1, -1)
    for axis in (2, 1, 0):
        layers = np.moveaxis(signs, axis, 0)
        for known, layer in (*pairwise(layers), *pairwise(layers[::-1])):
            np.copyto(layer, known, where=layer == 0)
    return signs > 0


def _range_of_box(model: ShapeModel, found: Fit, grid: Grid) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
    """First indices of the voxels among which the model's box lies, and those past the last; equal where none do."""
    half = canonical_box(model)
    corners = half * np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), axis=-1).reshape(-1, 3)
    reach = grid.to_index(found.pose.to_world(corners))
    low = np.clip(np.floor(reach.min(axis=0)), 0, grid.shape).astype(int)
    high = np.clip(np.ceil(reach.max(axis=0)) + 1, 0, grid.shape).astype(int)
    return low, np.maximum(low, high)


def _is_in_box(model: ShapeModel, found: Fit, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    return np.asarray((np.abs(found.pose.to_canonical(points)) <= canonical_box(model)).all(axis=1))
