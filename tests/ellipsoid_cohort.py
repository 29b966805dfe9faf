"""Random ellipsoids as a training cohort: small, and with exact labels."""

import numpy as np

from model.geometry import Grid
from tests.analytic_shapes import Ellipsoid
from training.samples import ShapePoints

#: 1 mm voxels around the origin.
GRID = Grid((25, 25, 25), np.array([[1.0, 0, 0, -12], [0, 1, 0, -12], [0, 0, 1, -12], [0, 0, 0, 1]]))


def ellipsoid_points(shape: Ellipsoid) -> ShapePoints:
    """Every voxel centre of the grid, labelled; near within 3 mm by the field's own measure."""
    points = GRID.centres()
    field = shape.logits(points)
    return ShapePoints(points.astype(np.float32), field > 0, np.abs(field) < 3.0)


def ellipsoids(count: int, seed: int = 0) -> list[Ellipsoid]:
    """Random ellipsoids at the origin, along the axes."""
    axes = np.random.default_rng(seed).uniform(5.5, 9.5, (count, 3))
    return [Ellipsoid((float(a), float(b), float(c))) for a, b, c in axes]


def cohort(count: int = 5) -> list[ShapePoints]:
    """Points of random ellipsoids."""
    return [ellipsoid_points(shape) for shape in ellipsoids(count)]
