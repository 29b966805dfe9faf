"""Where an object lies and how far it reaches."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.geometry import Grid
from training.placing import centroid, inner_points, reach, reach_with_voxels

RNG = np.random.default_rng(0)
MASK = RNG.random((7, 6, 5)) > 0.6
GRID = Grid(
    MASK.shape, np.array([[0.0, 0.0, 1.5, -20.0], [-1.0, 0.0, 0.0, 30.0], [0.0, 2.0, 0.0, 5.0], [0, 0, 0, 1.0]])
)


@given(st.tuples(*[st.floats(-100.0, 100.0)] * 3))
def test_moving_a_mask_moves_its_centroid_and_leaves_its_reach(shift):
    affine = GRID.affine.copy()
    affine[:3, 3] += shift
    moved = Grid(GRID.shape, affine)
    np.testing.assert_allclose(centroid(MASK, moved), centroid(MASK, GRID) + shift, atol=1e-9)
    np.testing.assert_allclose(reach(MASK, moved), reach(MASK, GRID), atol=1e-9)


@pytest.mark.parametrize("pad", [1, 4])
def test_background_changes_nothing(pad):
    affine = GRID.affine.copy()
    affine[:3, 3] = GRID.to_world(np.full((1, 3), -float(pad)))[0]
    wide = np.pad(MASK, pad)
    np.testing.assert_allclose(centroid(wide, Grid(wide.shape, affine)), centroid(MASK, GRID))
    np.testing.assert_allclose(reach(wide, Grid(wide.shape, affine)), reach(MASK, GRID))


def test_the_box_holds_every_voxel_and_touches_one_on_each_axis():
    away = np.abs(inner_points(MASK, GRID) - centroid(MASK, GRID))
    assert (away <= reach(MASK, GRID) + 1e-12).all()
    np.testing.assert_allclose(away.max(axis=0), reach(MASK, GRID))
    assert (reach_with_voxels(MASK, GRID) >= reach(MASK, GRID) + GRID.spacing / 2).all()
