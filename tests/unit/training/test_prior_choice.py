"""Which of several priors is taken: the most fitted one that costs nothing."""

import pytest

from training.prior_choice import MODELS, Choice, choice_by
from training.pruning import PriorParts

PARTS = PriorParts(flow=False, least_movement=0.02, least_of_training=0.3)
WIDE = PriorParts(flow=False, least_movement=0.02, least_of_training=1.0)
WHOLE = PriorParts(flow=False, least_movement=0.0, least_of_training=1.0)


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ({None: 0.04, PARTS: 0.03, WIDE: 0.02}, Choice(PARTS, 0.03, 0.04)),
        ({None: 0.04, PARTS: 0.04, WIDE: 0.02}, Choice(PARTS, 0.04, 0.04)),
        ({None: 0.04, PARTS: 0.05, WIDE: 0.04}, Choice(WIDE, 0.04, 0.04)),
        ({None: 0.04, PARTS: 0.05, WIDE: 0.05}, Choice(WHOLE, 0.04, 0.04)),
    ],
)
def test_the_most_fitted_prior_that_is_no_worse_than_none(errors, expected):
    asked = []

    def error(parts):
        asked.append(parts)
        return errors[parts]

    assert choice_by(error, PARTS) == expected
    assert asked[:2] == [None, PARTS]
    assert len(asked) <= MODELS
