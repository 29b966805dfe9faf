"""Memory of a fine surface in a large box, against that of the whole grid."""

import tracemalloc

import numpy as np

from model.inference.isosurface import extract_surface
from tests.analytic_shapes import Ellipsoid

HALF = np.array([80.0, 60.0, 50.0])
STEP_MM = 0.25


def in_pieces(function, size=20_000):
    """The shape's own temporaries are not what is measured."""
    return lambda points: np.concatenate([function(points[k : k + size]) for k in range(0, len(points), size)])


def test_a_quarter_of_a_millimetre_does_not_need_the_whole_grid():
    shape = Ellipsoid((42.0, 31.0, 22.0), np.array([3.1, -2.2, 1.3]))
    nodes = np.prod(2.0 * HALF / STEP_MM + 1)
    tracemalloc.start()
    mesh = extract_surface(in_pieces(shape.logits), -HALF, HALF, STEP_MM)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(mesh.vertices) > 150_000
    assert np.abs(shape.logits(mesh.vertices)).max() < 0.01
    # Single-precision values alone, without the masks and copies that a level of them needs.
    assert peak < 4 * nodes / 2
