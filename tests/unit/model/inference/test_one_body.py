"""Maps and surface show the same body, and a drawing of two is told of."""

import numpy as np
import pytest

from model.geometry import Grid
from model.inference.mesh import volume_ml
from model.inference.observations import MaskStack
from model.inference.one_body import OCCUPIED, body_mask, of_one_body, separate_warnings
from model.inference.reconstruction import Options, reconstruct
from model.inference.surface import covering_grid
from model.inference.uncertainty import occupancy
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import ORTHOGONAL, PARALLEL, cube_around, drawn, observed

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
OBJECT = Ellipsoid((12.0, 9.0, 7.0), CENTRE)
#: Beside it, in the same slices.
OTHER = Ellipsoid((6.0, 6.0, 6.0), CENTRE + np.array([0.0, 17.5, 0.0]))
GRID = cube_around(CENTRE, nodes=61)


def both_drawn(grid: Grid = GRID) -> MaskStack:
    """Two objects on the same slices."""
    middle = [index + 10 for index in (14, 17, 20, 23, 26)]
    filled = np.zeros(grid.shape, bool)
    for index in middle:
        filled[:, :, index] = (OBJECT.mask(grid) | OTHER.mask(grid))[:, :, index]
    return MaskStack("mask[0]", grid, filled, np.zeros_like(filled))


def filled_ml(probability: np.ndarray, grid: Grid) -> float:
    """Volume of the voxels that are more likely inside than not."""
    return float(np.count_nonzero(probability >= OCCUPIED) * grid.spacing.prod() / 1000.0)


def test_a_second_drawn_object_is_in_neither_map_nor_surface_and_is_told_of():
    answer = reconstruct(MODEL, [both_drawn()], Options(fidelity=0.85))
    whole = occupancy(MODEL, answer.state, GRID)
    body = of_one_body(whole, GRID, answer.mesh)
    assert filled_ml(whole, GRID) > 1.1 * volume_ml(answer.mesh)
    assert filled_ml(body, GRID) == pytest.approx(volume_ml(answer.mesh), rel=0.02)
    assert np.array_equal(body_mask(MODEL, answer.state, answer.mesh, GRID), body >= OCCUPIED)
    assert any("one connected object" in warning for warning in answer.warnings)


@pytest.mark.parametrize("planes", [ORTHOGONAL, PARALLEL])
@pytest.mark.parametrize("spacing_mm", [0.7, 1.0, 3.0])
def test_a_map_of_one_object_stays_as_it_is(planes, spacing_mm):
    grid = cube_around(CENTRE)
    answer = reconstruct(MODEL, [drawn(OBJECT, grid, planes)], Options(annotated=planes))
    around = covering_grid(answer.mesh, spacing_mm)
    whole = occupancy(MODEL, answer.state, around)
    assert np.array_equal(of_one_body(whole, around, answer.mesh), whole)
    assert not any("one connected object" in warning for warning in answer.warnings)


def test_a_voxel_of_doubt_goes_with_the_body_that_is_nearest():
    answer = reconstruct(MODEL, [drawn(OBJECT, cube_around(CENTRE))], Options())
    probability = np.where(OBJECT.mask(GRID), 0.9, np.where(OTHER.mask(GRID), 0.8, 0.0))
    ends = np.stack([OTHER.centre, CENTRE]) + np.array([[0.0, 7.0, 0.0], [13.0, 0.0, 0.0]])
    tip, beside = map(tuple, np.rint(GRID.to_index(ends)).astype(int))
    probability[tip] = probability[beside] = 0.3
    body = of_one_body(probability, GRID, answer.mesh)
    assert body[tip] == 0.0
    assert body[beside] == 0.3
    assert np.array_equal(body >= OCCUPIED, OBJECT.mask(GRID))


def test_what_the_model_leaves_out_of_one_body_is_no_other_body():
    stack = drawn(OBJECT, cube_around(CENTRE))
    answer = reconstruct(MODEL, [stack], Options())
    observations = observed(stack)
    assert separate_warnings(observations, np.full(len(observations.points), -1.0), answer.mesh) == ()
