"""Parameters that come as text."""

import json

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from model.errors import InvalidParameter
from model.inference.observations import Plane
from service.request_schemas import MOST_PLANES, parse_annotated, parse_labels

planes = st.lists(
    st.builds(Plane, st.integers(0, 9), st.integers(0, 2), st.integers(0, 10_000)), min_size=1, max_size=5
)


@pytest.mark.parametrize("rule", ["auto", "all", "nonempty"])
def test_rules_stand_for_themselves(rule):
    assert parse_annotated(f" {rule} ") == rule


@given(planes)
def test_planes_survive_json(chosen):
    text = json.dumps([{"stack": p.stack, "axis": p.axis, "index": p.index} for p in chosen])
    assert parse_annotated(text) == tuple(chosen)


@given(planes)
def test_a_plane_without_its_stack_is_of_the_first(chosen):
    text = json.dumps([{"axis": p.axis, "index": p.index} for p in chosen])
    assert parse_annotated(text) == tuple(Plane(0, p.axis, p.index) for p in chosen)


@pytest.mark.parametrize(
    "item",
    [{"axis": 3, "index": 1}, {"axis": 0, "index": -1}, {"axis": 0, "index": 15.5}, {"axis": 0, "index": "15"}, {}, 7],
)
def test_an_entry_that_is_no_plane_is_named(item):
    planes = [{"axis": 0, "index": 15}, item, {"axis": 1, "index": 36}]
    with pytest.raises(InvalidParameter, match=r"annotated\[1\] is no plane") as caught:
        parse_annotated(json.dumps(planes))
    assert caught.value.part == "annotated[1]"


def test_a_member_that_stands_twice_is_refused():
    with pytest.raises(InvalidParameter):
        parse_annotated('[{"axis": 0, "index": 15, "axis": 1}, {"axis": 1, "index": 36}]')


@given(st.text())
def test_any_other_text_is_refused_in_a_sentence(text):
    assume(text.strip() not in ("auto", "all", "nonempty"))
    with pytest.raises(InvalidParameter) as caught:
        parse_annotated(text)
    assert caught.value.part == "annotated"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        "3",
        "null",
        '["a"]',
        '[{"stack": 0}]',
        '[{"stack": 0, "axis": 3, "index": 1}]',
        "[" * 100_000,
        '[{"stack": 0, "axis": 1, "index": -1}]',
        '[{"stack": 0, "axis": 1, "index": 1, "x": 1}]',
        '[{"stack": 0, "axis": 1.5, "index": 1}]',
        '[{"stack": true, "axis": 1, "index": 1}]',
    ],
)
def test_what_is_no_list_of_planes_is_refused(text):
    with pytest.raises(InvalidParameter):
        parse_annotated(text)


def test_more_different_planes_than_masks_have_are_refused_and_repeated_ones_count_once():
    text = [{"axis": 2, "index": index} for index in range(MOST_PLANES)]
    assert len(set(parse_annotated(json.dumps(text * 2)))) == MOST_PLANES
    with pytest.raises(InvalidParameter, match=f"{MOST_PLANES + 1} different planes; at most {MOST_PLANES}") as caught:
        parse_annotated(json.dumps([*text, {"axis": 1, "index": 0}]))
    assert caught.value.part == "annotated"


@given(st.frozensets(st.integers(1, 2**31 - 1), min_size=1, max_size=6), st.booleans())
def test_labels_may_be_repeated_or_separated_by_commas(labels, repeated):
    words = [str(label) for label in labels]
    assert parse_labels(words if repeated else [", ".join(words)]) == labels


def test_no_label_means_all_of_them():
    assert parse_labels([]) is None
    assert parse_labels([""]) is None


@pytest.mark.parametrize("text", ["0", "-1", "2147483648", "1.5", "one", "1,,2", "²", "1" * 5000])
def test_labels_that_no_mask_can_hold_are_refused(text):
    with pytest.raises(InvalidParameter):
        parse_labels([text])
