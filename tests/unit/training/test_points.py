from dataclasses import replace

import numpy as np
import pytest

from model.geometry import Grid
from tests.analytic_shapes import Ellipsoid
from training.cohorts import Case
from training.cohorts.inspect import extent_mm
from training.points import (
    BAND_MM,
    LEAST_INSIDE,
    SMALL_MM,
    cohort_points,
    cuts_are_ends,
    decoder_extent,
    reduction,
    shape_points,
    window,
)
from training.sparsify import REGIMES

AFFINE = np.array([[0.0, 0.0, 1.5, -20.0], [-1.0, 0.0, 0.0, 30.0], [0.0, 1.0, 0.0, 5.0], [0.0, 0.0, 0.0, 1.0]])
LIMIT = 100_000


def ellipsoid_case(margin=6, name="e"):
    grid = Grid((24 + 2 * margin, 30 + 2 * margin, 14 + 2 * margin), AFFINE)
    centre = grid.to_world((np.array([grid.shape]) - 1) / 2)[0]
    shape = Ellipsoid((9.0, 11.0, 13.0), centre)
    return Case(name, name, "train", shape.mask(grid), grid), shape


@pytest.mark.parametrize("margin", [0, 3, 12])
def test_a_window_moves_no_voxel_in_the_world(margin):
    case, _ = ellipsoid_case(margin)
    found = window(case)
    before = case.grid.to_world(np.argwhere(case.mask).astype(float))
    after = found.grid.to_world(np.argwhere(found.mask).astype(float))
    assert np.allclose(np.sort(before, axis=0), np.sort(after, axis=0))


@pytest.mark.parametrize("regime", ["thin", "orthogonal", "dense"])
def test_labels_are_those_of_the_shape_at_the_points(regime):
    case, shape = ellipsoid_case()
    found = shape_points(window(case), regime, np.random.default_rng(0), LIMIT)
    world = found.points + shape.centre
    clear = np.abs(shape.logits(world)) > 1e-3
    assert np.array_equal(found.labels[clear], shape.logits(world)[clear] > 0)


@pytest.mark.parametrize("regime", REGIMES)
def test_near_points_lie_around_the_contour_and_both_labels_are_there(regime):
    case, shape = ellipsoid_case()
    found = shape_points(window(case), regime, np.random.default_rng(1), LIMIT)
    assert found.labels.any()
    assert (~found.labels).any()
    assert found.near.any()
    if regime == "dense":
        deep = np.abs(shape.logits(found.points + shape.centre)) > BAND_MM + 1.5
        assert not found.near[deep].any()


def test_beyond_a_face_that_cuts_the_object_nothing_is_said():
    mask = np.zeros((10, 10, 10), bool)
    mask[3:7, 3:7, 4:] = True
    case = Case("cut", "cut", "train", mask, Grid(mask.shape, np.eye(4)))
    centre = np.argwhere(mask).mean(axis=0)
    for regime in REGIMES:
        open_end = shape_points(window(case), regime, np.random.default_rng(0), LIMIT).points + centre
        closed = shape_points(window(case, cut_is_end=True), regime, np.random.default_rng(0), LIMIT).points + centre
        inside_columns = (open_end[:, :2] > 3).all(axis=1) & (open_end[:, :2] < 6).all(axis=1)
        assert not (open_end[inside_columns, 2] > 9.5 + 4).any()
        assert (closed[:, 2] > 9.5).any()


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize(("slices", "margin"), [(1, 3), (2, 3), (5, 3), (7, 3), (4, 0)])
def test_flat_objects_have_points_inside_whatever_the_drawing(regime, slices, margin):
    mask = np.zeros((14, 14, slices + 2 * margin), bool)
    mask[3:11, 3:11, margin : margin + slices] = True
    case = Case("flat", "flat", "train", mask, Grid(mask.shape, np.diag([2.0, 2.0, 10.0, 1.0])))
    for seed in range(10):
        found = shape_points(window(case), regime, np.random.default_rng(seed), LIMIT)
        assert found.labels.any()
    assert decoder_extent([found]) > 0.0


def test_a_small_limit_leaves_points_inside():
    mask = np.zeros((60, 60, 60), bool)
    mask[30, 20:40, 30:34] = True
    case = Case("thread", "thread", "train", mask, Grid(mask.shape, np.eye(4)))
    known = window(case)
    few = shape_points(known, "dense", np.random.default_rng(0), 200)
    assert few.labels.sum() == LEAST_INSIDE
    least = shape_points(known, "dense", np.random.default_rng(0), 20)
    assert least.labels.sum() == 20


def scaled(case, factor):
    return replace(case, grid=Grid(case.grid.shape, np.diag([factor] * 3 + [1.0]) @ case.grid.affine))


@pytest.mark.parametrize("regime", REGIMES)
def test_points_of_small_objects_shrink_along_with_them(regime):
    case, _ = ellipsoid_case()
    small = scaled(case, SMALL_MM / extent_mm(case.mask, case.grid))
    one, other = (
        shape_points(window(found), regime, np.random.default_rng(0), LIMIT) for found in (small, scaled(small, 0.1))
    )
    np.testing.assert_allclose(one.points, 10.0 * other.points, rtol=1e-3, atol=1e-3)
    np.testing.assert_array_equal(one.labels, other.labels)
    np.testing.assert_array_equal(one.near, other.near)
    assert 0.2 < one.labels[one.near].mean() < 0.8


def test_organs_keep_the_method_s_distances():
    case, _ = ellipsoid_case()
    assert reduction(case.mask, case.grid) == 1.0
    assert reduction(scaled(case, 0.1).mask, scaled(case, 0.1).grid) < 0.2


@pytest.mark.parametrize("regime", REGIMES)
@pytest.mark.parametrize("factor", [2.0, 6.0])
def test_large_voxels_have_near_points_of_both_labels(regime, factor):
    case, _ = ellipsoid_case()
    found = shape_points(window(scaled(case, factor)), regime, np.random.default_rng(0), LIMIT)
    assert found.labels[found.near].any()
    assert not found.labels[found.near].all()


def test_where_most_masks_touch_their_crops_cuts_are_ends_for_all():
    whole, _ = ellipsoid_case()
    cut = replace(whole, mask=whole.mask[:18], grid=Grid((18, *whole.grid.shape[1:]), whole.grid.affine))
    assert cuts_are_ends([cut, cut, whole])
    assert not cuts_are_ends([cut, whole])
    (ended,), (opened,) = (cohort_points([cut], "dense", 0, cut_is_end=end) for end in (True, False))
    (by_rule,) = cohort_points([cut], "dense", 0)
    np.testing.assert_array_equal(by_rule.points, ended.points)
    assert len(opened.points) < len(ended.points)


def test_points_are_a_pure_function_of_their_seed():
    cases = [ellipsoid_case(name=str(n))[0] for n in range(2)]
    one, other = cohort_points(cases, "orthogonal", 3), cohort_points(cases, "orthogonal", 3)
    assert all(np.array_equal(a.points, b.points) for a, b in zip(one, other, strict=True))
    different = cohort_points(cases, "orthogonal", 4)
    assert any(
        a.points.shape != b.points.shape or not np.allclose(a.points, b.points)
        for a, b in zip(one, different, strict=True)
    )


def test_the_extent_holds_every_shape():
    found = [shape_points(window(ellipsoid_case()[0]), "dense", np.random.default_rng(0), LIMIT)]
    extent = decoder_extent(found)
    assert extent > np.abs(found[0].points[found[0].labels]).max()
    assert extent == pytest.approx(13.0 * 1.25, abs=2.0)
