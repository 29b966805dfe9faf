"""Validation of a mask volume."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.errors import InvalidGeometry, InvalidMask, InvalidParameter
from model.inference.stacks import UNIT_FACTOR, label_warnings, make_stack, require_length

AFFINE = np.diag([1.0, 2.0, 3.0, 1.0])


def values_with(*labels, shape=(4, 5, 6)):
    values = np.zeros(shape, np.int64)
    values.ravel()[: len(labels)] = labels
    return values


@pytest.mark.parametrize("kind", [bool, np.uint8, np.int16, np.uint64, np.float32, np.float64])
def test_integers_of_any_type_are_labels(kind):
    stack = make_stack("mask[0]", values_with(1, 1, 0, 1).astype(kind), AFFINE)
    assert stack.foreground.sum() == 3
    assert not stack.excluded.any()
    assert stack.grid.shape == (4, 5, 6)


@given(st.sets(st.integers(1, 254), min_size=1), st.sets(st.integers(1, 254), min_size=1), st.booleans())
def test_named_labels_are_foreground_and_255_is_excluded(present, wanted, floating):
    values = values_with(*sorted(present), 255, shape=(7, 7, 7))
    values = values.astype(np.float32) if floating else values
    if present.isdisjoint(wanted):
        with pytest.raises(InvalidMask, match=f"labels that are there: {min(present)}"):
            make_stack("mask[0]", values, AFFINE, frozenset(wanted))
        return
    stack = make_stack("mask[0]", values, AFFINE, frozenset(wanted))
    np.testing.assert_array_equal(stack.foreground, np.isin(values, sorted(wanted)))
    np.testing.assert_array_equal(stack.excluded, values == 255)


def test_rounding_of_stored_scales_is_forgiven():
    values = values_with(1, 2).astype(np.float64) * (1 + 1e-7)
    assert make_stack("mask[0]", values, AFFINE, frozenset({2})).foreground.sum() == 1


@pytest.mark.parametrize(
    ("values", "sentence"),
    [
        (values_with(), "no foreground"),
        (values_with(255), "never looked at"),
        (values_with(1) * 0.5, "soft"),
        (np.where(values_with(1) == 1, np.inf, 0.0), "non-finite"),
        (np.where(values_with(1) == 1, np.nan, 0.0), "non-finite"),
        (values_with(-1), "negative"),
        (values_with(*range(1, 300), shape=(8, 8, 8)), "picture"),
        (np.ones((4, 5), np.uint8), "2 dimensions"),
        (np.ones((4, 5, 6, 2), np.uint8), "4 dimensions"),
        (np.ones((0, 5, 6), np.uint8), "no foreground"),
        (np.ones((4, 5, 6), complex), "no plain numbers"),
        (np.full((4, 5, 6), "1"), "no plain numbers"),
    ],
)
def test_unusable_masks_are_refused(values, sentence):
    with pytest.raises(InvalidMask, match=sentence) as caught:
        make_stack("mask[3]", values, AFFINE)
    assert caught.value.part == "mask[3]"
    assert str(caught.value).startswith("mask[3] ")


def test_a_picture_is_accepted_when_labels_are_named():
    values = values_with(*range(1, 300), shape=(8, 8, 8))
    assert make_stack("mask[0]", values, AFFINE, frozenset({7})).foreground.sum() == 1


def test_a_long_list_of_labels_is_cut():
    with pytest.raises(InvalidMask, match="and 88 more"):
        make_stack("mask[0]", values_with(*range(1, 101), shape=(8, 8, 8)), AFFINE, frozenset({200}))


@pytest.mark.parametrize("labels", [(), (0,), (-3, 1), (1, 255)])
def test_labels_no_object_can_have(labels):
    with pytest.raises(InvalidParameter) as caught:
        make_stack("mask[0]", values_with(1), AFFINE, frozenset(labels))
    assert caught.value.part == "label"


@given(
    st.integers(0, 2**32 - 1),
    st.tuples(*[st.floats(0.01, 100.0)] * 3),
    st.permutations(range(3)),
    st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3),
)
def test_any_rotation_permutation_reflection_and_spacing_is_a_grid(seed, spacing, order, signs):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    affine = np.eye(4)
    affine[:3, :3] = turn @ np.diag(signs)[:, list(order)] @ np.diag(spacing)
    affine[:3, 3] = (-120.0, 40.0, 900.0)
    stack = make_stack("mask[0]", values_with(1), affine)
    np.testing.assert_allclose(stack.grid.spacing, spacing, rtol=1e-9)


@given(st.floats(0.002, 0.98), st.permutations(range(3)))
def test_shear_is_refused_whatever_the_axes(cosine, order):
    linear = np.eye(3)
    linear[:, order[0]] += cosine / np.sqrt(1 - cosine**2) * linear[:, order[1]]
    affine = np.eye(4)
    affine[:3, :3] = linear * (0.5, 3.0, 1.0)
    with pytest.raises(InvalidGeometry, match="sheared"):
        make_stack("mask[0]", values_with(1), affine)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 1e9])
@pytest.mark.parametrize("place", [(0, 0), (2, 1), (1, 3)])
def test_affines_no_grid_can_have(value, place):
    affine = AFFINE.copy()
    affine[place] = value
    with pytest.raises(InvalidGeometry):
        make_stack("mask[0]", values_with(1), affine)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_zero_spacing_is_refused(axis):
    affine = AFFINE.copy()
    affine[:, axis] = 0.0
    with pytest.raises(InvalidGeometry, match="spacing"):
        make_stack("mask[0]", values_with(1), affine)


def test_the_affine_passed_in_stays_as_it_is():
    affine = AFFINE.copy()
    stack = make_stack("mask[0]", values_with(1), affine)
    affine[0, 3] = 77.0
    assert stack.grid.affine[0, 3] == 0.0


def test_an_object_in_another_unit_is_too_short():
    values = np.zeros((40, 4, 4), np.uint8)
    values[:, 1, 1] = 1
    metres, millimetres = (make_stack("mask[0]", values, np.diag([step] * 3 + [1.0])) for step in (0.001, 1.0))
    require_length([metres, millimetres], 50.0)
    with pytest.raises(InvalidMask, match="whose voxel spacing is in mm"):
        require_length([metres], 50.0)


def test_labels_that_no_stack_holds_are_told():
    first, second = (make_stack("mask[0]", values_with(*held), AFFINE, frozenset({1, 3})) for held in ((1, 2), (3,)))
    assert label_warnings([first, second]) == label_warnings([]) == ()
    assert label_warnings([first])[0].startswith("mask[0] does not hold label 3;")
    assert label_warnings([second, second])[0].startswith("No mask holds label 1;")


@given(st.floats(0.01, 100.0), st.integers(0, 2), st.integers(1, 4))
def test_an_object_may_be_so_many_times_as_long_as_the_models(spacing, axis, count):
    values = np.zeros((4, 4, 4), np.uint8)
    np.moveaxis(values, axis, 0)[:count, 0, 0] = 1
    stack = make_stack("mask[1]", values, np.diag([spacing, spacing, spacing, 1.0]))
    longest_mm = count * spacing / UNIT_FACTOR
    require_length([stack], 1.001 * longest_mm)
    with pytest.raises(InvalidMask, match=r"mask\[1\] holds an object .* mm long") as refused:
        require_length([stack], 0.999 * longest_mm)
    assert refused.value.part == "mask[1]"
