"""The first difference between two runs, in words."""

import pytest

from training.difference import first_difference

RUN = {
    "config": {"steps": 150, "seed": 0, "decoder": {"width": 8, "extent_mm": 9.0}},
    "train": {"a": "1", "b": "2"},
    "side": "left",
}


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({}, ""),
        ({"config": {**RUN["config"], "steps": 200}}, "steps: 150 there, 200 asked"),
        ({"config": {**RUN["config"], "decoder": {"width": 9, "extent_mm": 9.0}}}, "decoder.width: 8 there, 9 asked"),
        (
            {"train": {"a": "1"}, "config": {**RUN["config"], "decoder": {"width": 8, "extent_mm": 7.0}}},
            "training shapes: 2 there, 1 asked",
        ),
        ({"train": {"a": "1", "b": "3"}}, "training shapes: others are asked"),
        ({"config": {**RUN["config"], "seed": 4}, "train": {"c": "1"}}, "seed: 0 there, 4 asked"),
        ({"side": None}, "side: left there, None asked"),
    ],
)
def test_the_difference_from_which_others_follow_is_named(asked, words):
    assert first_difference(RUN, {**RUN, **asked}) == words
