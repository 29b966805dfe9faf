"""Annotated planes and weighted observations."""

from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.errors import InconsistentStacks, InvalidMask, InvalidParameter
from model.geometry import Grid
from model.inference.observations import COVER_MARGIN_MM, MaskStack, Plane, find_planes, observe, thinned
from model.inference.plane_sampling import (
    band_width,
    contour_distance,
    inclusion_probabilities,
    systematic_sample,
)

SHAPE = (30, 34, 26)
semi_axes = st.tuples(*[st.floats(6.0, 11.0)] * 3)
centres = st.tuples(*[st.floats(12.5, 13.5)] * 3)


def ellipsoid(radii=(9.0, 11.0, 8.0), centre=(14.2, 16.7, 12.4), shape=SHAPE):
    offsets = (np.indices(shape).T - centre) / radii
    return (offsets**2).sum(axis=-1).T <= 1.0


def cut(solid, planes):
    """What is left of a solid on some (axis, index) planes."""
    drawn = np.zeros_like(solid)
    for axis, index in planes:
        np.moveaxis(drawn, axis, 0)[index] |= np.moveaxis(solid, axis, 0)[index]
    return drawn


def stack_of(foreground, spacing=(1.0, 1.0, 1.0), origin=(0.0, 0.0, 0.0), excluded=None, part="mask[0]"):
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = origin
    none = np.zeros(foreground.shape, bool)
    return MaskStack(part, Grid(foreground.shape, affine), foreground, none if excluded is None else excluded)


def found(foreground, rule="auto", **kwargs):
    return [(p.axis, p.index) for p in find_planes([stack_of(foreground, **kwargs)], rule)]


def held(solid, axis):
    return np.flatnonzero(np.moveaxis(solid, axis, 0).any(axis=(1, 2)))


# planes


@given(semi_axes, centres, st.tuples(*[st.floats(-0.8, 0.8)] * 3))
def test_auto_finds_three_orthogonal_slices(radii, centre, where):
    solid = ellipsoid(radii, centre)
    drawn = [(axis, round(centre[axis] + where[axis] * (radii[axis] - 1.5))) for axis in range(3)]
    assert found(cut(solid, drawn)) == drawn


@given(semi_axes, centres, st.integers(0, 2), st.integers(2, 8), st.data())
def test_auto_finds_every_nth_slice(radii, centre, axis, step, data):
    solid = ellipsoid(radii, centre)
    first = data.draw(st.integers(0, step - 1))
    drawn = [(axis, int(index)) for index in held(solid, axis) if index % step == first]
    if len(drawn) >= 2:
        assert found(cut(solid, drawn)) == drawn


@given(semi_axes, centres, st.integers(0, 2), st.integers(-5, 4), st.integers(1, 5))
def test_auto_finds_two_parallel_slices(radii, centre, axis, first, gap):
    drawn = [(axis, round(centre[axis]) + first), (axis, min(round(centre[axis]) + first + gap, 18))]
    solid = ellipsoid(tuple(np.maximum(radii, 8.0)), centre)
    assert found(cut(solid, drawn)) == drawn


@given(semi_axes, centres, st.integers(0, 2))
def test_auto_finds_two_crossing_slices(radii, centre, left_out):
    drawn = [(axis, round(centre[axis])) for axis in range(3) if axis != left_out]
    assert found(cut(ellipsoid(radii, centre), drawn)) == drawn


@given(semi_axes, centres)
def test_auto_cuts_a_dense_mask_along_the_axis_with_fewest_planes(radii, centre):
    solid = ellipsoid(radii, centre)
    planes = find_planes([stack_of(solid)], "auto")
    fewest = min(range(3), key=lambda axis: (len(held(solid, axis)), -axis))
    assert [(p.axis, p.index) for p in planes] == [(fewest, int(i)) for i in held(solid, fewest)]


def test_auto_of_a_symmetric_mask_takes_the_last_axis():
    assert {axis for axis, _ in found(ellipsoid((8, 8, 8), (12, 12, 12)))} == {2}


def test_a_narrow_rod_in_many_slices_is_not_taken_for_few_long_ones():
    solid = np.zeros((12, 12, 60), bool)
    solid[4:9, 4:9] = True
    drawn = [(2, index) for index in range(0, 60, 4)]
    assert found(cut(solid, drawn)) == drawn


def test_single_voxel_tips_belong_to_the_plane_they_were_drawn_on():
    drawn = cut(ellipsoid(), [(2, 8), (2, 16)])
    drawn[14, 16, 4] = drawn[14, 16, 20] = True
    assert found(drawn) == [(2, 4), (2, 8), (2, 16), (2, 20)]


@given(st.integers(0, 10**6))
def test_auto_holds_all_foreground_of_any_mask_and_no_plane_is_needless(seed):
    rng = np.random.default_rng(seed)
    mask = rng.random((7, 6, 8)) < rng.choice([0.02, 0.2, 0.6])
    if mask.sum() < 2:
        return
    try:
        planes = found(mask)
    except InvalidMask:
        assert min(len(held(mask, axis)) for axis in range(3)) == 1
        return
    np.testing.assert_array_equal(cut(mask, planes), mask)
    for plane in planes:
        others = [other for other in planes if other != plane]
        assert (cut(mask, others) != mask).any() or len(planes) <= 2


def test_all_takes_every_plane_along_the_thickest_axis_and_nonempty_those_with_foreground():
    drawn = cut(ellipsoid(), [(1, 10), (1, 18)])
    assert found(drawn, "all", spacing=(1, 4, 1)) == [(1, index) for index in range(SHAPE[1])]
    assert found(drawn, "nonempty", spacing=(1, 4, 1)) == [(1, 10), (1, 18)]


def test_equal_spacings_are_told_apart_by_the_foreground():
    drawn = cut(ellipsoid(), [(1, 10), (1, 18)])
    assert found(drawn, "all") == [(1, index) for index in range(SHAPE[1])]
    assert found(drawn, "nonempty") == [(1, 10), (1, 18)]
    symmetric = ellipsoid((8, 8, 8), (12, 12, 12))
    assert {axis for axis, _ in found(symmetric, "nonempty")} == {2}


def test_planes_never_looked_at_are_not_annotated():
    drawn = cut(ellipsoid(), [(2, 8), (2, 16)])
    excluded = np.ones(SHAPE, bool)
    excluded[:, :, [8, 12, 16]] = False
    planes = found(drawn, "all", excluded=excluded, spacing=(1, 1, 5))
    assert planes == [(2, 8), (2, 12), (2, 16)]


def test_planes_are_counted_over_all_stacks():
    one = stack_of(cut(ellipsoid(), [(2, 12)]))
    two = stack_of(cut(ellipsoid(), [(0, 14)]), part="mask[1]")
    assert find_planes([one, two], "auto") == (Plane(0, 2, 12), Plane(1, 0, 14))
    for rule in ("auto", "nonempty"):
        with pytest.raises(InvalidMask, match="one slice only"):
            find_planes([stack_of(cut(ellipsoid(), [(2, 12)]), spacing=(1, 1, 3))], rule)


def test_named_planes_are_sorted_and_each_taken_once():
    stack = stack_of(ellipsoid())
    named = [Plane(0, 2, 12), Plane(0, 0, 3), Plane(0, 2, 12)]
    assert find_planes([stack], named) == (Plane(0, 0, 3), Plane(0, 2, 12))


@pytest.mark.parametrize(
    ("plane", "sentence"),
    [
        (Plane(1, 0, 0), "stack 1"),
        (Plane(-1, 0, 0), "stack -1"),
        (Plane(0, 3, 0), "axis 3"),
        (Plane(0, 1, 34), "plane 34 along axis 1"),
        (Plane(0, 2, -1), "plane -1 along axis 2"),
    ],
)
def test_named_planes_that_are_not_there(plane, sentence):
    with pytest.raises(InvalidParameter, match=sentence) as caught:
        find_planes([stack_of(ellipsoid())], [Plane(0, 2, 12), plane])
    assert caught.value.part == "annotated[1]"


@pytest.mark.parametrize("named", [[], [Plane(0, 2, 12)], [Plane(0, 2, 12)] * 2])
def test_fewer_than_two_named_planes(named):
    with pytest.raises(InvalidParameter, match="at least two"):
        find_planes([stack_of(ellipsoid())], named)


def test_named_planes_without_foreground():
    with pytest.raises(InvalidMask, match="no foreground"):
        find_planes([stack_of(ellipsoid())], [Plane(0, 2, 0), Plane(0, 2, 1)])


@pytest.mark.parametrize("gap", [0.0, 19.0, 21.0, 500.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_stacks_must_lie_in_one_place(gap, axis):
    solid = cut(ellipsoid(), [(2, 8), (2, 16)])
    origin = np.zeros(3)
    origin[axis] = gap + held(solid, axis)[-1] - held(solid, axis)[0]
    stacks = [stack_of(solid), stack_of(solid, origin=origin, part="mask[1]")]
    if gap <= 20.0:
        assert len(find_planes(stacks, "auto", 20.0)) == 4
        return
    with pytest.raises(InconsistentStacks, match=r"mask\[0\] and mask\[1\]") as caught:
        find_planes(stacks, "auto", 20.0)
    assert caught.value.part == "mask[1]"


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_stacks_may_be_near_each_other_through_others(order):
    solid = cut(ellipsoid(), [(2, 12)])
    parts = [stack_of(solid, origin=(0.0, 0.0, 15.0 * place), part=f"mask[{n}]") for n, place in enumerate(order)]
    ends = [part for part, place in zip(parts, order, strict=True) if place != 1]
    assert len(find_planes(parts, [Plane(number, 2, 12) for number in range(3)], 20.0)) == 3
    with pytest.raises(InconsistentStacks):
        find_planes(ends, [Plane(0, 2, 12), Plane(1, 2, 12)], 20.0)


# observations


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
    solid = ellipsoid((60.0, 55.0, 50.0), (70.0, 69.0, 71.0), (140, 140, 140))
    stack = stack_of(solid)
    planes = find_planes([stack], "all")
    seen = [observe([stack], planes, budget=4000, seed=seed) for seed in range(8)]
    assert {int(index) % 2 for o in seen for index in o.points[:, 2]} == {0, 1}
    for observations in seen:
        assert len({int(index) % 2 for index in observations.points[:, 2]}) == 1
        np.testing.assert_allclose(observations.weights.sum(), solid.size, rtol=0.05)
        np.testing.assert_allclose(observations.weights @ observations.labels, solid.sum(), rtol=0.1)


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
