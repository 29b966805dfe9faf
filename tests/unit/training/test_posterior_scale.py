"""Width of posterior SDs, recovered from errors that were drawn with a known one."""

import numpy as np
import pytest

from model.inference.reliability import Figures
from training.posterior_scale import posterior_scale
from training.usual import LEAST_SD, Sound, typical_figures

RANDOM = np.random.default_rng(2)
#: Log prior density of the mean shape (nats), where a model is asked for it.
PEAK = 20.0


def sound(scale=1.0, offset_mm=0.0, count=400, surface_scale=None):
    """Answers whose volume SDs are too narrow by a factor, and which share an offset."""
    answers = []
    for _ in range(count):
        swelling, sd = RANDOM.uniform(1.0, 2.0), RANDOM.uniform(0.02, 0.3)
        error = RANDOM.normal() * np.hypot(scale * sd, offset_mm * swelling)
        planes = int(RANDOM.integers(3, 9))
        figures = Figures(planes, float(np.exp(RANDOM.normal(-1.0, 0.3)) * planes**0.2), 0.4)
        surprises = tuple(RANDOM.normal(0.1, 0.4, 3))
        surface = 0.5 * (surface_scale or scale)
        answers.append(Sound(figures, RANDOM.normal(12.0, 2.0), surprises, surface, 0.5, error, sd, swelling))
    return answers


@pytest.mark.parametrize(("scale", "offset_mm"), [(1.0, 0.0), (1.4, 0.0), (0.8, 0.1)])
def test_factor_and_offset_are_found(scale, offset_mm):
    found = posterior_scale(sound(scale, offset_mm))
    assert found["sd_scale"] == pytest.approx(scale, rel=0.25)
    assert found["offset_mm"] == pytest.approx(offset_mm, abs=0.06)


@pytest.mark.parametrize(("scale", "offset_mm"), [(1.3, 0.0), (1.0, 0.1)])
def test_intervals_of_other_answers_hold_their_share(scale, offset_mm):
    found = posterior_scale(sound(scale, offset_mm, 300))
    for level, reach in ((0.9, 1.645), (0.5, 0.6745)):
        held = [
            abs(one.volume_error_ml)
            < reach * np.hypot(found["sd_scale"] * one.volume_sd_ml, found["offset_mm"] * one.swelling_ml)
            for one in sound(scale, offset_mm, 1000)
        ]
        assert np.mean(held) == pytest.approx(level, abs=0.08)


def test_few_answers_leave_the_factor_near_that_of_the_vertices():
    for _ in range(5):
        found = posterior_scale(sound(1.0, 0.0, 2, surface_scale=1.5))
        assert found["vertex_ratio"] == pytest.approx(1.5)
        assert 1.0 < found["sd_scale"] < 2.0


def test_typical_figures_are_those_of_the_answers():
    found = typical_figures(sound(), cases=8, peak=PEAK)
    assert found["freedom"] == 15.0
    assert found["density_peak"] == PEAK
    assert found["rarity_mean"] == pytest.approx(np.cbrt(PEAK - 12.0), abs=0.1)
    assert found["rarity_sd"] == pytest.approx(2.0 / 3.0 / np.cbrt(PEAK - 12.0) ** 2, rel=0.2)
    assert found["misfit_exponent"] == pytest.approx(0.2, abs=0.15)
    assert found["misfit_sd"] == pytest.approx(0.3, rel=0.15)
    assert found["slice_sd"] == pytest.approx(0.4, rel=0.15)


def test_alike_answers_do_not_make_the_judge_merciless():
    found = typical_figures(sound(count=1) * 6, cases=1, peak=PEAK)
    assert {name: found[f"{name}_sd"] for name in ("misfit", "rarity")} == {
        name: LEAST_SD[name] for name in ("misfit", "rarity")
    }
