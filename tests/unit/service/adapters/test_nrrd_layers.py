"""Segmentations of 3-D Slicer with overlapping segments."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from model.errors import InvalidMask
from service.adapters.images import read_mask
from service.adapters.nrrd_layers import CHUNK, MAX_LAYERS, layers_by_value, merged
from tests.bad_inputs import LIMITS, drawn
from tests.layered_segmentations import layered_segmentation

FIRST, SECOND = drawn((2,)), drawn((2, 6))


def foreground_of(layers, segments=(), labels=None):
    chosen = None if labels is None else frozenset(labels)
    return read_mask(layered_segmentation(layers, segments), "mask[0]", LIMITS, chosen).foreground


def test_layers_are_merged_when_no_label_is_named():
    stack = read_mask(layered_segmentation([FIRST, SECOND]), "mask[0]", LIMITS)
    np.testing.assert_array_equal(stack.foreground, (FIRST > 0) | (SECOND > 0))
    np.testing.assert_allclose(stack.grid.spacing, (2, 1, 1))
    np.testing.assert_allclose(stack.grid.affine[:3, 3], (-1, -2, 3))


@pytest.mark.parametrize("segments", [(), [(0, 1), (1, 2)]])
@pytest.mark.parametrize("labels", [(1,), (2,), (1, 2)])
def test_labels_of_their_own_may_be_named(segments, labels):
    wanted = {1: FIRST > 0, 2: SECOND > 0}
    found = foreground_of([FIRST, 2 * SECOND], segments, labels)
    np.testing.assert_array_equal(found, np.any([wanted[label] for label in labels], axis=0))


@pytest.mark.parametrize("segments", [(), [(0, 1), (1, 1)]])
def test_one_label_of_two_segments_is_ambiguous(segments):
    with pytest.raises(InvalidMask, match=r"label 1 for different segments.*label of its own, or no label"):
        foreground_of([FIRST, SECOND], segments, (1,))


def test_a_label_that_only_one_of_its_segments_has_drawn_is_not_ambiguous():
    found = foreground_of([FIRST, 2 * SECOND], [(0, 1), (1, 1), (1, 2)], (1,))
    np.testing.assert_array_equal(found, FIRST > 0)


def test_a_value_of_a_layer_without_such_a_segment_is_nobodys():
    found = foreground_of([FIRST, SECOND], [(0, 1), (1, 2)], (1,))
    np.testing.assert_array_equal(found, FIRST > 0)


def test_one_ambiguous_label_does_not_keep_others_from_being_named():
    three = np.where(drawn((4,)) > 0, 3, FIRST)
    np.testing.assert_array_equal(foreground_of([three, SECOND], (), (3,)), three == 3)


def test_a_label_of_no_layer_is_refused_with_those_that_are_there():
    with pytest.raises(InvalidMask, match="labels that are there: 1, 2"):
        foreground_of([FIRST, 2 * drawn((6,))], (), (7,))


def test_one_layer_may_be_picked_by_label():
    np.testing.assert_array_equal(foreground_of([drawn()], (), (1,)), drawn() == 1)


def test_voxels_that_any_layer_excludes_are_excluded():
    unseen = np.zeros_like(FIRST)
    unseen[:, :, 2] = 255
    for labels in (None, frozenset({1})):
        stack = read_mask(layered_segmentation([SECOND, unseen]), "mask[0]", LIMITS, labels)
        np.testing.assert_array_equal(stack.excluded, unseen == 255)
        assert not (stack.foreground & stack.excluded).any()


@pytest.mark.parametrize("count", [MAX_LAYERS, MAX_LAYERS + 1])
def test_layers_are_limited(count):
    layers = [drawn((2,)), *[np.zeros((6, 7, 8), np.uint8)] * (count - 1)]
    if count <= MAX_LAYERS:
        np.testing.assert_array_equal(foreground_of(layers), layers[0] > 0)
        return
    with pytest.raises(InvalidMask, match="layers"):
        foreground_of(layers)


small = arrays(np.uint8, st.tuples(st.integers(1, 4), *[st.integers(1, 4)] * 3), elements=st.integers(0, 3))


@given(small, st.frozensets(st.integers(1, 3), min_size=1))
def test_a_voxel_has_a_named_label_exactly_where_a_layer_has_it(layers, labels):
    held = [{layer for layer in range(len(layers)) if (layers[layer] == label).any()} for label in labels]
    if any(len(some) > 1 for some in held):
        with pytest.raises(InvalidMask):
            merged(np.asfortranarray(layers), labels, {}, "mask[0]")
        return
    found = merged(np.asfortranarray(layers), labels, {}, "mask[0]")
    wanted = sorted(labels)
    np.testing.assert_array_equal(np.isin(found, wanted), np.isin(layers, wanted).any(axis=0))


def test_layers_of_more_voxels_than_are_merged_at_a_time():
    layers = np.zeros((3, 128, 128, 64), np.uint8, order="F")
    assert layers.size > 2 * CHUNK
    layers[0, :100, 5], layers[2, :, 120] = 1, 2
    found = merged(layers, frozenset({1, 2}), {}, "mask[0]")
    np.testing.assert_array_equal(found, layers.max(axis=0))
    layers[1, 0, 0, 63] = 1
    with pytest.raises(InvalidMask):
        merged(layers, frozenset({1}), {}, "mask[0]")


def test_segments_are_placed_where_layer_and_value_are_numbers():
    pairs = {
        "Segment0_Layer": "0",
        "Segment0_LabelValue": "1",
        "Segment12_LabelValue": "1",
        "Segment12_Layer": "3",
        "Segment1_Layer": "1",
        "Segment2_LabelValue": "2",
        "Segment3_Layer": "x",
        "Segment3_LabelValue": "9" * 5000,
        "Segment_Layer": "1",
        "Segment4_Color": "0 0 1",
        "Segment\N{SUPERSCRIPT TWO}_Layer": "1",
    }
    assert layers_by_value(pairs) == {1: {0, 3}}
