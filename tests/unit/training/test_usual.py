"""Highest usual figures: how many sound answers of further cases lie above them."""

import numpy as np
import pytest

from model.inference.reliability import USUAL_PLANES, Figures
from training.usual import Sound, freedom_of, usual_figures

PLANES = (3, 3, 5, 8)
EXPONENT = -0.5


def drawings_of(cases: int, rng: np.random.Generator) -> list[Sound]:
    """Answers whose misfit falls with the number of planes and differs between cases as much as between drawings."""
    return [
        sound(planes, np.exp(own + 0.2 * rng.standard_normal()) * (planes / USUAL_PLANES) ** EXPONENT)
        for own in 0.2 * rng.standard_normal(cases)
        for planes in PLANES
    ]


def sound(planes: int, misfit_mm: float) -> Sound:
    return Sound(Figures(planes, misfit_mm, misfit_mm), 0.0, (), 0.0, 0.0, 0.0, 0.0, 0.0)


def share_above(cases: int, trials: int = 200) -> float:
    """Share of answers to further cases above the limit that so many cases gave, over as many calibrations."""
    rng = np.random.default_rng(cases)
    above = []
    for _ in range(trials):
        usual = usual_figures(drawings_of(cases, rng), cases)
        for one in drawings_of(5, rng):
            limit = usual["misfit_mm"] * (one.figures.planes / USUAL_PLANES) ** usual["misfit_exponent"]
            above.append(one.figures.misfit_mm > limit)
    return float(np.mean(above))


@pytest.mark.parametrize("cases", [3, 4, 8, 24])
def test_few_of_further_sound_drawings_lie_above(cases):
    assert 0.02 < share_above(cases) < 0.07


def test_many_drawings_are_taken_at_their_word():
    rng = np.random.default_rng(0)
    misfits = np.exp(np.concatenate([rng.standard_normal(400), 3.0 + rng.standard_normal(40)]))
    usual = usual_figures([sound(USUAL_PLANES, misfit) for misfit in misfits], 88)
    assert usual["misfit_mm"] == pytest.approx(np.exp(np.quantile(np.log(misfits), 0.95)), rel=1e-3)


def test_a_single_drawing_is_its_own_limit():
    assert usual_figures([sound(3, 0.4)], 1)["misfit_mm"] == pytest.approx(0.4)
    assert freedom_of(1) == 3
