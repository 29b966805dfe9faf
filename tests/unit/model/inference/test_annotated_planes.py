"""Which planes of a mask count as annotated."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.errors import InconsistentStacks, InvalidMask, InvalidParameter
from model.geometry import Grid
from model.inference.annotated_planes import planes_and_repeats, repeat_warnings
from model.inference.observations import MaskStack, Plane, find_planes
from tests.mask_stacks import SHAPE, centres, cut, ellipsoid, found, held, semi_axes, stack_of


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
    drawn = [(axis, round(centre[axis]) + first), (axis, min(round(centre[axis]) + first + gap, 19))]
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


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("rule", ["auto", "all", "nonempty"])
def test_a_stack_of_one_slice_has_that_slice_however_small_its_section(axis, rule):
    shape = np.insert([30, 30], axis, 1)
    thin, other = np.zeros(shape, bool), np.zeros(shape, bool)
    np.moveaxis(thin, axis, 0)[0, 10, 10:13] = True
    np.moveaxis(other, axis, 0)[0, 8:14, 9:15] = True
    stacks = [stack_of(thin), stack_of(other, origin=tuple(np.insert([0.0, 0.0], axis, 4.0)), part="mask[1]")]
    assert find_planes(stacks, rule) == (Plane(0, axis, 0), Plane(1, axis, 0))


def test_many_stacks_are_one_object_through_their_neighbours():
    solid = np.zeros((6, 6, 1), bool)
    solid[1:5, 1:5] = True
    chain = [
        stack_of(solid, origin=(0.0, 0.0, 9.0 * n), part=f"mask[{n}]") for n in np.random.default_rng(0).permutation(60)
    ]
    assert len(find_planes(chain, "auto", gap_mm=10.0)) == 60
    with pytest.raises(InconsistentStacks, match="apart in the world"):
        find_planes([*chain, stack_of(solid, origin=(0.0, 0.0, 560.0), part="mask[60]")], "auto", gap_mm=10.0)


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


def test_a_named_plane_that_was_never_looked_at_is_refused():
    excluded = np.zeros(SHAPE, bool)
    excluded[:, :, 20] = True
    stack = stack_of(cut(ellipsoid(), [(2, 12)]), excluded=excluded)
    with pytest.raises(InvalidParameter, match=r"annotated\[1\] names a plane that was never looked at") as caught:
        find_planes([stack], [Plane(0, 2, 12), Plane(0, 2, 20), Plane(0, 2, 20)])
    assert caught.value.part == "annotated[1]"
    excluded[14, 16, 20] = False
    assert len(find_planes([stack_of(stack.foreground, excluded=excluded)], [Plane(0, 2, 12), Plane(0, 2, 20)])) == 2


def test_a_row_of_the_one_slice_that_was_looked_at_is_no_second_plane():
    solid, excluded = cut(ellipsoid(), [(2, 12)]), np.ones(SHAPE, bool)
    excluded[:, :, 12] = False
    with pytest.raises(InvalidParameter, match="one slice only"):
        find_planes([stack_of(solid, excluded=excluded)], [Plane(0, 2, 12), Plane(0, 0, 14)])
    thin = stack_of(solid[:, :, 12:13])
    with pytest.raises(InvalidParameter, match="one slice only"):
        find_planes([thin], [Plane(0, 2, 0), Plane(0, 0, 14)])


def turned(stack, angles, part="mask[1]"):
    """The same stack, in a frame of the world that is turned."""
    affine = np.eye(4)
    affine[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    return replace(stack, part=part, grid=Grid(stack.grid.shape, affine @ stack.grid.affine))


@given(st.floats(-0.49, 0.49), st.integers(0, 2), st.sampled_from(["auto", "nonempty", "named"]))
def test_one_slice_sent_twice_is_one_slice(shift, axis, rule):
    spacing = (1.0, 1.0, 3.0)
    solid = cut(ellipsoid(), [(axis, 13)])
    origin = np.zeros(3)
    origin[axis] = shift * spacing[axis]
    stacks = [stack_of(solid, spacing), stack_of(solid, spacing, origin=origin, part="mask[1]")]
    if rule != "auto" and axis != 2:
        rule = "named"
    named = [Plane(0, axis, 13), Plane(1, axis, 13)]
    with pytest.raises((InvalidMask, InvalidParameter), match="one slice only"):
        find_planes(stacks, named if rule == "named" else rule)


@pytest.mark.parametrize("rule", ["auto", "named"])
def test_one_slice_sent_in_another_frame_of_voxels_is_one_slice(rule):
    solid = cut(ellipsoid(), [(2, 12)])
    one = stack_of(solid, origin=(3.0, -40.0, 7.0))
    moved = np.moveaxis(solid[::-1], 2, 0)
    affine = np.eye(4)
    affine[:3, :3] = one.grid.affine[:3, :3][:, [2, 0, 1]] * (1, -1, 1)
    affine[:3, 3] = one.grid.affine[:3, 3] + (SHAPE[0] - 1) * one.grid.affine[:3, 0]
    two = MaskStack("mask[1]", Grid(moved.shape, affine), moved, np.zeros(moved.shape, bool))
    named = [Plane(0, 2, 12), Plane(1, 0, 12)]
    with pytest.raises((InvalidMask, InvalidParameter), match="one slice only"):
        find_planes([one, two], named if rule == "named" else rule)


def test_slices_that_are_farther_apart_or_turned_are_two():
    one = stack_of(cut(ellipsoid(), [(2, 12)]))
    apart = stack_of(one.foreground, origin=(0.0, 0.0, 0.6), part="mask[1]")
    assert len(find_planes([one, apart], "auto")) == 2
    assert len(find_planes([one, turned(one, (20, 0, 0))], "auto")) == 2


def test_a_slice_sent_twice_beside_others_counts_once():
    one = stack_of(cut(ellipsoid(), [(2, 12)]))
    two = stack_of(cut(ellipsoid(), [(2, 12), (2, 16)]), part="mask[1]")
    assert find_planes([one, two], "auto") == (Plane(0, 2, 12), Plane(1, 2, 16))


def test_named_planes_without_foreground():
    with pytest.raises(InvalidMask, match="no foreground"):
        find_planes([stack_of(ellipsoid())], [Plane(0, 2, 0), Plane(0, 2, 1)])


@pytest.mark.parametrize("gap", [1.0, 19.0, 21.0, 500.0])
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


class TestRepeats:
    """A drawing that is sent twice knows no more than one."""

    PLANES = ((0, 14), (1, 16), (2, 12))
    DRAWN = stack_of(cut(ellipsoid(), PLANES))

    def test_a_place_counts_once(self):
        once = find_planes([self.DRAWN], "auto")
        again = replace(self.DRAWN, part="mask[1]")
        assert find_planes([self.DRAWN, again], "auto") == once
        planes, repeats = planes_and_repeats([self.DRAWN, again], "auto")
        assert planes == once
        (told,) = repeat_warnings([self.DRAWN, again], repeats)
        assert told.startswith("mask[1] shows 3 plane(s)")
        assert planes_and_repeats([self.DRAWN], "auto") == (once, ())

    def test_a_named_place_counts_once(self):
        named = [Plane(stack, axis, index) for stack in (0, 1) for axis, index in self.PLANES]
        assert find_planes([self.DRAWN] * 2, named) == tuple(sorted(named)[:3])

    def test_a_turned_grid_shows_the_same_places(self):
        turned = np.moveaxis(self.DRAWN.foreground, (0, 1, 2), (2, 0, 1))
        affine = np.zeros((4, 4))
        affine[[0, 1, 2, 3], [2, 0, 1, 3]] = 1.0
        other = MaskStack("mask[1]", Grid(turned.shape, affine), turned, np.zeros_like(turned))
        assert find_planes([self.DRAWN, other], "auto") == find_planes([self.DRAWN], "auto")

    @pytest.mark.parametrize(
        "other",
        [
            stack_of(cut(ellipsoid(), PLANES), origin=(0.3, 0.3, 0.3)),
            stack_of(cut(ellipsoid(), ((0, 15), (1, 17), (2, 13)))),
        ],
        ids=["beside them", "of other indices"],
    )
    def test_other_places_count(self, other):
        assert len(find_planes([self.DRAWN, replace(other, part="mask[1]")], "auto")) == 6

    def test_the_other_half_of_a_plane_counts(self):
        halves = [np.zeros(SHAPE, bool) for _ in range(2)]
        halves[0][:16], halves[1][16:] = True, True
        stacks = [
            stack_of(self.DRAWN.foreground & half, excluded=~half, part=f"mask[{number}]")
            for number, half in enumerate(halves)
        ]
        planes = find_planes(stacks, [Plane(0, 2, 12), Plane(0, 1, 16), Plane(1, 2, 12)])
        assert Plane(1, 2, 12) in planes
