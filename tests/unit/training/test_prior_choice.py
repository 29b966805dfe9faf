"""Which of several priors is taken: the most fitted one that surely costs nothing."""

import numpy as np
import pytest

from training.prior_choice import MODELS, Choice, choice_by
from training.pruning import PriorParts

PARTS = PriorParts(flow=False, least_movement=0.02, least_of_training=0.3)
WIDE = PriorParts(flow=False, least_movement=0.02, least_of_training=1.0)
WHOLE = PriorParts(flow=False, least_movement=0.0, least_of_training=1.0, keep_centre=True)
TRAINED = np.linspace(0.03, 0.05, 16)
NOISE = np.random.default_rng(0).standard_normal(16)
NOISE -= NOISE.mean()


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({PARTS: -0.01 + 1e-3 * NOISE, WIDE: -0.02}, Choice(PARTS, 0.03, 0.04)),
        ({PARTS: 0.0, WIDE: -0.02}, Choice(PARTS, 0.04, 0.04)),
        ({PARTS: 1e-3 * NOISE, WIDE: 1e-5 * NOISE}, Choice(WIDE, 0.04, 0.04)),
        ({PARTS: 0.01, WIDE: 5e-5 + 1e-5 * NOISE}, Choice(WIDE, 0.04005, 0.04)),
        ({PARTS: 0.01, WIDE: 0.01}, Choice(WHOLE, 0.04, 0.04)),
        ({PARTS: -0.001 + 3e-3 * NOISE, WIDE: 1e-3 * NOISE}, Choice(WHOLE, 0.04, 0.04)),
    ],
)
def test_the_most_fitted_prior_that_is_surely_as_good_as_none(more, expected):
    asked = []

    def errors(parts):
        asked.append(parts)
        return TRAINED + more[parts]

    found = choice_by(TRAINED, errors, PARTS)
    assert found.parts == expected.parts
    assert (found.error, found.trained_error) == pytest.approx((expected.error, expected.trained_error))
    assert asked[0] == PARTS
    assert len(asked) < MODELS


def test_a_single_case_tells_nothing():
    assert choice_by(TRAINED[:1], lambda parts: TRAINED[:1] - 0.01, PARTS).parts == WHOLE
