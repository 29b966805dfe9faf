"""What is told of a result beside the model's warnings, on spheres."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.geometry import Grid
from model.inference.mesh import mesh_of, volume_ml
from service.cautions import COARSE_SHARE, coarse_cautions, grid_cautions, share_within

RADIUS = 10.0


def ball(centre=(0.0, 0.0, 0.0)):
    found = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    return mesh_of(np.asarray(found.vertices) + centre, np.asarray(found.faces))


def grid_from(low, high, spacing=(1.0, 1.0, 1.0), seed=None):
    """Voxels that fill a box (mm), turned about the origin with a seed."""
    shape = np.rint((np.array(high) - low) / spacing).astype(int)
    affine = np.eye(4)
    affine[:3, :3] = np.diag(spacing)
    affine[:3, 3] = np.array(low) + np.array(spacing) / 2
    if seed is not None:
        affine[:3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix() @ affine[:3]
    return Grid((int(shape[0]), int(shape[1]), int(shape[2])), affine)


def share_below(height):
    """Share of the ball's volume below a plane."""
    depth = height + RADIUS
    return depth**2 * (3 * RADIUS - depth) / (4 * RADIUS**3)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("height", [-6.0, 0.0, 4.0, 8.0])
@pytest.mark.parametrize("seed", [None, 5])
def test_what_a_grid_holds_of_a_ball_is_a_spherical_cap(axis, height, seed):
    high = np.full(3, 12.0)
    high[axis] = height
    assert share_within(ball(), grid_from((-12.0, -12.0, -12.0), high, seed=seed)) == pytest.approx(
        share_below(height), abs=2e-3
    )


def test_what_is_cut_along_all_axes_is_an_octant():
    assert share_within(ball(), grid_from((0.0, 0.0, 0.0), (12.0, 12.0, 12.0))) == pytest.approx(1 / 8, abs=5e-3)


@given(st.integers(0, 20), st.floats(-4.0, 4.0))
def test_a_grid_that_holds_all_is_told_nothing_of(seed, shift):
    grid = grid_from((-15.0, -15.0, -15.0), (15.0, 15.0, 15.0), seed=seed)
    assert share_within(ball((shift, 0.0, 0.0)), grid) == pytest.approx(1.0, abs=1e-9)
    assert grid_cautions(ball((shift, 0.0, 0.0)), grid) == ()


@pytest.mark.parametrize(("top", "spacing", "told"), [(9.5, 1.0, False), (8.0, 1.0, True), (8.0, 4.0, False)])
def test_a_surface_within_a_voxel_of_the_border_is_not_cut(top, spacing, told):
    grid = grid_from((-12.0, -12.0, -12.0), (12.0, 12.0, top), (1.0, 1.0, spacing))
    assert bool(grid_cautions(ball(), grid)) is told


def test_how_far_and_how_much_is_told():
    (sentence,) = grid_cautions(ball(), grid_from((-12.0, -12.0, -6.0), (12.0, 12.0, 6.0), (1.0, 1.0, 3.0)))
    assert "4.0 mm beyond the grid of the first mask" in sentence
    assert "79 % of the body" in sentence
    (all_gone,) = grid_cautions(ball(), grid_from((20.0, 20.0, 20.0), (25.0, 25.0, 25.0)))
    assert "0 % of the body" in all_gone


@given(st.floats(0.5, 1.5), st.floats(0.25, 10.0), st.floats(0.5, 2.0))
def test_a_mesh_that_encloses_another_volume_than_is_told_is_told_of(factor, step_mm, judged_mm):
    figure_ml = factor * volume_ml(ball())
    differs = step_mm > judged_mm and abs(1 / factor - 1) > COARSE_SHARE
    assert bool(coarse_cautions(ball(), step_mm, figure_ml, judged_mm)) is differs
    assert coarse_cautions(ball(), None, figure_ml, judged_mm) == ()


def test_both_volumes_and_steps_are_told():
    assert coarse_cautions(ball(), 4.0, 5.0, 1.0) == (
        "The mesh at 4 mm encloses 4.18 mL; figures are measured at 1 mm.",
    )
