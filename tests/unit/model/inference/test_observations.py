"""Weighted observations of annotated planes, and the sampling that they are drawn by."""

from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.errors import InvalidMask, InvalidParameter
from model.geometry import Grid
from model.inference.observations import COVER_MARGIN_MM, MaskStack, Plane, find_planes, observe, thinned
from model.inference.plane_sampling import (
    band_width,
    contour_distance,
    inclusion_probabilities,
    systematic_sample,
)
from tests.mask_stacks import SHAPE, cut, ellipsoid, stack_of


def example(spacing=(1.0, 1.5, 3.0)):
    solid = ellipsoid()
    stack = stack_of(cut(solid, [(0, 14), (1, 17), (2, 8), (2, 16)]), spacing=spacing)
    return stack, find_planes([stack], "auto")


def annotated_voxels(stack, planes):
    """Index of every distinct annotated voxel (small grids: the window holds them all)."""
    seen = cut(~stack.excluded, [(p.axis, p.index) for p in planes])
    return np.argwhere(seen)


def test_with_budget_enough_every_annotated_voxel_is_used_once():
    stack, planes = example()
    everything = observe([stack], planes, budget=10**6, seed=0)
    index = np.rint(stack.grid.to_index(everything.points)).astype(int)
    order = np.lexsort(index.T[::-1])
    np.testing.assert_array_equal(index[order], annotated_voxels(stack, planes))
    np.testing.assert_array_equal(everything.labels == 1.0, stack.foreground[tuple(index.T)])


def test_weights_are_the_area_of_the_plane_each_point_came_from():
    stack, planes = example()
    everything = observe([stack], planes, budget=10**6, seed=0)
    areas = np.array([np.delete(stack.grid.spacing, plane.axis).prod() for plane in planes])
    np.testing.assert_allclose(everything.weights, areas[everything.plane_of])
    index = np.rint(stack.grid.to_index(everything.points)).astype(int)
    for number, plane in enumerate(planes):
        assert (index[everything.plane_of == number, plane.axis] == plane.index).all()


@pytest.mark.parametrize("budget", [16, 60, 300, 900, 2500])
def test_weighted_sums_are_unbiased(budget):
    stack, planes = example()
    everything = observe([stack], planes, budget=10**6, seed=0)

    def sums(observations):
        x, y, z = observations.points.T
        functions = [np.ones_like(x), observations.labels, x * y, np.sin(z), (observations.plane_of == 1).astype(float)]
        return np.array(functions) @ observations.weights

    drawn = np.array([sums(observe([stack], planes, budget=budget, seed=seed)) for seed in range(400)])
    error = drawn.std(axis=0) / np.sqrt(len(drawn))
    assert (np.abs(drawn.mean(axis=0) - sums(everything)) <= 4.5 * error + 1e-8 * np.abs(sums(everything))).all()


@pytest.mark.parametrize("budget", [16, 100, 1000, 2000])
def test_the_budget_is_kept_and_used(budget):
    stack, planes = example()
    observations = observe([stack], planes, budget=budget, seed=3)
    assert len(observations.points) == budget
    assert (observations.weights > 0).all()


def test_all_voxels_of_the_band_are_used_when_they_fit():
    stack, planes = example((1.0, 1.0, 1.0))
    observations = observe([stack], planes, budget=2600, seed=0)
    used = np.zeros(SHAPE, bool)
    used[tuple(np.rint(stack.grid.to_index(observations.points)).astype(int).T)] = True
    for plane in planes:
        section = np.moveaxis(stack.foreground, plane.axis, 0)[plane.index]
        distance = contour_distance(section, np.zeros_like(section), np.ones(2))
        assert np.moveaxis(used, plane.axis, 0)[plane.index][distance <= 2.5].all()
    assert not used[14].all()


def test_a_limited_cover_keeps_the_band_and_the_sums():
    stack, planes = example((1.0, 1.0, 1.0))
    whole, limited = (observe([stack], planes, budget=10**6, seed=1, cover=cover) for cover in (np.inf, 0.5))
    certain = np.isclose(limited.weights, limited.weights.min())
    assert len(limited.points) < 0.7 * len(whole.points)
    assert max(300, round(0.5 * certain.sum())) >= (~certain).sum()
    np.testing.assert_allclose(limited.weights.sum(), whole.weights.sum(), rtol=0.15)


@pytest.mark.parametrize("budget", [500, 2500])
def test_without_a_contour_the_budget_is_used_all_the_same(budget):
    full = stack_of(np.ones(SHAPE, bool))
    planes = [Plane(0, 2, index) for index in range(SHAPE[2])]
    observations = observe([full], planes, budget=budget, seed=0)
    assert len(observations.points) == pytest.approx(budget, abs=1)
    assert observations.labels.all()
    limited = observe([full], planes, budget=budget, seed=0, cover=0.5)
    assert len(limited.points) == pytest.approx(300, abs=1)


def test_the_same_seed_gives_the_same_observations():
    stack, planes = example()
    one, two, other = (observe([stack], planes, budget=700, seed=seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.points, two.points)
    np.testing.assert_array_equal(one.weights, two.weights)
    assert not np.array_equal(one.points, other.points)


def test_excluded_voxels_are_never_used_and_make_no_contour():
    solid = ellipsoid()
    excluded = np.zeros(SHAPE, bool)
    excluded[:, 17:] = True
    stack = stack_of(cut(solid, [(2, 8), (2, 16)]) & ~excluded, excluded=excluded)
    planes = find_planes([stack], "auto")
    observations = observe([stack], planes, budget=10**6, seed=0)
    index = np.rint(stack.grid.to_index(observations.points)).astype(int)
    assert (index[:, 1] < 17).all()
    assert len(index) == 2 * SHAPE[0] * 17
    middle = contour_distance(stack.foreground[:, :, 8], excluded[:, :, 8], np.ones(2))[14, 16]
    assert middle > 5.0


@given(
    st.sampled_from(list(permutations(range(3)))),
    st.sampled_from(list(product([1, -1], repeat=3))),
    st.sampled_from(["auto", "nonempty", "all"]),
)
def test_another_storage_order_of_the_same_voxels_is_the_same_in_the_world(order, signs, rule):
    solid = ellipsoid((9.0, 11.0, 8.0))
    drawn = cut(solid, [(0, 14), (1, 17), (2, 8)] if rule == "auto" else [(2, 8), (2, 16)])
    excluded = np.zeros(SHAPE, bool)
    excluded[:5] = True
    stack = stack_of(drawn & ~excluded, spacing=(1.0, 1.5, 3.0), origin=(-20.0, 7.0, 100.0), excluded=excluded)
    step = np.zeros((4, 4))
    step[3, 3] = 1.0
    for new, old in enumerate(order):
        step[old, new] = signs[new]
        step[old, 3] = 0.0 if signs[new] == 1 else SHAPE[old] - 1.0

    def stored(volume):
        return np.transpose(volume, order)[tuple(slice(None, None, sign) for sign in signs)]

    shape = tuple(SHAPE[old] for old in order)
    other = MaskStack("mask[0]", Grid(shape, stack.grid.affine @ step), stored(stack.foreground), stored(excluded))
    rows = []
    for each in (stack, other):
        observations = observe([each], find_planes([each], rule), budget=10**6, seed=0)
        table = np.column_stack([observations.points, observations.labels, observations.weights])
        rows.append(table[np.lexsort(np.round(table, 6).T)])
    np.testing.assert_allclose(rows[0], rows[1], atol=1e-8)


def test_finer_grids_do_not_count_more():
    totals = []
    for factor in (1, 2, 4):
        shape = (24 * factor, 24 * factor, 9)
        centre = (np.array([12.0, 12.0, 4.5]) - 0.5 / np.array([factor, factor, 1])) * (factor, factor, 1)
        solid = ellipsoid(np.array([8, 8, 4.0]) * (factor, factor, 1), centre, shape)
        stack = stack_of(cut(solid, [(2, 3), (2, 6)]), spacing=(1 / factor, 1 / factor, 3.0))
        observations = observe([stack], find_planes([stack], "auto"), budget=800, seed=0)
        totals.append(observations.weights.sum())
    np.testing.assert_allclose(totals, totals[0], rtol=0.08)


def test_the_cover_stays_near_the_object():
    mask = np.zeros((300, 300, 4), bool)
    mask[150:160, 150:160, [1, 2]] = True
    stack = stack_of(mask)
    observations = observe([stack], find_planes([stack], "auto"), budget=500, seed=0)
    assert (np.abs(observations.points[:, :2] - 154.5) <= 4.5 + COVER_MARGIN_MM).all()
    np.testing.assert_allclose(observations.weights.sum(), 2 * 70**2, rtol=0.1)


def test_large_dense_volumes_are_seen_on_evenly_spaced_planes():
    solid = ellipsoid((62.0, 60.0, 56.0), (75.0, 74.0, 76.0), (150, 150, 150))
    stack = stack_of(solid)
    planes = find_planes([stack], "all")
    shown = solid.any(axis=(0, 1))
    seen = [observe([stack], planes, budget=4000, seed=seed) for seed in range(8)]
    used = [np.unique(np.rint(observations.points[:, 2]).astype(int)) for observations in seen]
    assert {int(index) % 2 for indices in used for index in indices[shown[indices]]} == {0, 1}
    for observations, indices in zip(seen, used, strict=True):
        assert len({int(index) % 2 for index in indices[shown[indices]]}) == 1
        np.testing.assert_allclose(observations.weights.sum(), solid.size, rtol=0.05)
        np.testing.assert_allclose(observations.weights @ observations.labels, solid.sum(), rtol=0.1)


@pytest.mark.parametrize("empty", [60, 400])
def test_few_drawn_planes_among_many_empty_ones_are_all_seen(empty):
    mask = np.zeros((360, 360, empty), bool)
    drawn = [empty // 2 + offset for offset in (-9, -3, 3, 9)]
    mask[20:340, 20:340, drawn] = True
    stack = stack_of(mask, spacing=(0.5, 0.5, 0.5))
    planes = [Plane(0, 2, index) for index in range(empty)]
    for seed in range(3):
        observations = observe([stack], planes, budget=2000, seed=seed)
        labels = observations.labels > 0
        assert {planes[number].index for number in observations.plane_of[labels]} == set(drawn)
        np.testing.assert_allclose(observations.weights @ labels, 4 * 160.0**2, rtol=0.1)


def test_two_stacks_give_points_of_both_in_one_world():
    solid = ellipsoid()
    one = stack_of(cut(solid, [(2, 8), (2, 16)]), origin=(5.0, 0.0, 0.0))
    two = stack_of(cut(solid, [(0, 14)]), origin=(5.0, 0.0, 0.0), part="mask[1]")
    both = observe([one, two], find_planes([one, two], "auto"), budget=10**6, seed=0)
    for number, stack in enumerate([one, one, two]):
        index = np.rint(stack.grid.to_index(both.points[both.plane_of == number])).astype(int)
        np.testing.assert_array_equal(stack.foreground[tuple(index.T)], both.labels[both.plane_of == number] == 1)


def test_a_budget_too_small():
    stack, planes = example()
    with pytest.raises(InvalidParameter, match="at least 16"):
        observe([stack], planes, budget=15, seed=0)


def test_planes_that_nobody_looked_at_give_no_observations():
    stack = stack_of(ellipsoid(), excluded=np.ones(SHAPE, bool))
    with pytest.raises(InvalidMask, match="looked at"):
        observe([stack], [Plane(0, 2, 8), Plane(0, 2, 9)], budget=100, seed=0)


# sampling


@given(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=60), st.integers(1, 60), st.integers(0, 100))
def test_inclusion_probabilities_sum_to_the_sample_and_are_met(size, count, seed):
    sizes = np.array(size)
    probability = inclusion_probabilities(sizes, count)
    assert ((probability > 0) & (probability <= 1)).all()
    np.testing.assert_allclose(probability.sum(), min(count, len(sizes)), rtol=1e-9)
    free = probability < 1 - 1e-12
    if free.any():
        ratio = probability[free] / sizes[free]
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
        assert (probability[~free] >= ratio[0] * sizes[~free] * 0 + 1 - 1e-12).all()
    chosen = systematic_sample(probability, np.random.default_rng(seed))
    assert len(np.unique(chosen)) == len(chosen) == min(count, len(sizes))


def test_distance_of_a_disc_is_that_of_its_contour():
    y, x = np.mgrid[-40:41, -40:41] * np.array([0.5, 1.0])[:, None, None]
    radius = np.hypot(y, x)
    distance = contour_distance(radius <= 15.0, np.zeros((81, 81), bool), np.array([0.5, 1.0]))
    assert np.abs(distance - np.abs(radius - 15.0)).max() <= 1.2


@pytest.mark.parametrize(
    ("spacing", "width"), [((0.5, 0.4), 1.25), ((1.0, 1.0), 2.5), ((1.5, 1.0), 3.0), ((3.0, 1.0), 4.5)]
)
def test_band_width_follows_the_voxel(spacing, width):
    assert band_width(np.array(spacing)) == pytest.approx(width)


@pytest.mark.parametrize("every", [1, 2, 4, 7])
def test_thinning_keeps_weighted_sums_on_average(every):
    stack = stack_of(ellipsoid())
    observations = observe([stack], find_planes([stack], (Plane(0, 2, 8), Plane(0, 0, 14))), budget=600, seed=0)
    value = observations.labels * (2.0 + observations.points[:, 0])
    sums = []
    for seed in range(200):
        few = thinned(replace(observations, labels=value), every, seed=seed)
        sums.append(few.weights @ few.labels)
    assert len(few.points) == -(-len(value) // every)
    assert np.mean(sums) == pytest.approx(observations.weights @ value, rel=0.02)
