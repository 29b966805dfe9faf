import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.geometry import Grid
from tests.analytic_shapes import sphere
from training.metrics_masks import agreement, dice

SPACING = np.array([0.5, 0.5, 0.5])
GRID = Grid((56, 56, 56), np.block([[np.diag(SPACING), np.full((3, 1), -13.75)], [np.zeros((1, 3)), np.ones((1, 1))]]))


def ball(radius, centre=(0.0, 0.0, 0.0)):
    return sphere(radius, centre).mask(GRID)


def test_concentric_balls_lie_their_difference_of_radii_apart():
    result = agreement(ball(10.0), ball(7.0), SPACING)
    # Surface elements stand on the corners between voxels, up to half a voxel inside the surface or outside.
    assert result.asd_mm == pytest.approx(3.0, abs=0.5)
    assert result.hd95_mm == pytest.approx(3.0, abs=0.5)
    assert result.hd_mm >= result.hd95_mm
    assert result.dice == pytest.approx(2 * 7.0**3 / (10.0**3 + 7.0**3), abs=0.01)


@given(st.integers(0, 8))
def test_hausdorff_distance_of_shifted_boxes_is_the_shift(voxels):
    box, moved = np.zeros((2, 40, 30, 30), bool)
    box[8:20, 8:20, 8:20] = True
    moved[8 + voxels : 20 + voxels, 8:20, 8:20] = True
    result = agreement(box, moved, np.array([2.0, 1.0, 1.0]))
    assert result.hd_mm == pytest.approx(2.0 * voxels)
    assert result.dice == pytest.approx(1.0 - voxels / 12)


def test_order_of_the_masks_does_not_matter():
    a, b = ball(9.0), ball(8.0, (2.0, 1.0, 0.0))
    assert agreement(a, b, SPACING) == agreement(b, a, SPACING)


def test_all_distances_scale_with_the_voxel():
    a, b = ball(9.0), ball(8.0, (2.0, 1.0, 0.0))
    small, large = agreement(a, b, SPACING), agreement(a, b, 3.0 * SPACING)
    for name in ("asd_mm", "hd95_mm", "hd_mm"):
        assert getattr(large, name) == pytest.approx(3.0 * getattr(small, name))


def test_a_mask_agrees_with_itself():
    result = agreement(ball(9.0), ball(9.0), SPACING)
    assert (result.dice, result.asd_mm, result.hd95_mm, result.hd_mm) == (1.0, 0.0, 0.0, 0.0)


def test_empty_masks():
    nothing = np.zeros(GRID.shape, bool)
    for pair in ((nothing, ball(5.0)), (ball(5.0), nothing)):
        missed = agreement(*pair, SPACING)
        assert missed.dice == 0.0
        assert np.isinf([missed.asd_mm, missed.hd95_mm, missed.hd_mm]).all()
    assert agreement(nothing, nothing, SPACING).asd_mm == 0.0
    assert dice(nothing, nothing) == 1.0
