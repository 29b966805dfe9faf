"""What is said of shapes that are unlike those that a model knows, and of slices that contradict the others."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr

from model.inference.agreement import Section, sections_of
from model.inference.fitting import FitOptions, fit
from model.inference.observations import Plane
from model.inference.posterior import fitted_logits
from model.inference.reliability import MOST_USUAL_PLANES, Figures
from model.inference.typicality import (
    peak_density,
    predictive_probabilities,
    predictive_warnings,
    rarity,
    typicality,
    typicality_warnings,
)
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import cube_around, drawn, observed

CENTRE = np.array([30.0, -20.0, 50.0])
KNOWN = {
    "freedom": 15.0,
    "misfit_exponent": 0.1,
    "misfit_mean": -1.0,
    "misfit_sd": 0.2,
    "density_peak": float(-1.5 * np.log(2.0 * np.pi)),
    "rarity_mean": 1.0,
    "rarity_sd": 0.3,
    "slice_mean": 0.0,
    "slice_sd": 0.2,
}
PLAIN = ellipsoid_model()
MODEL = replace(PLAIN, manifest=replace(PLAIN.manifest, typical=KNOWN))
OBSERVATIONS = observed(drawn(Ellipsoid((14.0, 9.0, 6.0), CENTRE), cube_around(CENTRE)))
FOUND = fit(PLAIN, OBSERVATIONS, FitOptions())
USUAL = float(np.exp(-1.0))
spreads = st.floats(0.02, 20.0)


def percentile(misfit, planes=5, latent=(0.0, 0.0, 0.0)):
    return typicality(MODEL, replace(FOUND, latent=np.array(latent)), Figures(planes, misfit, 0.3))[1]


def section(surprise, index=0, trusted=True):
    return Section(Plane(0, 2, index), 50.0, 50.0, 45.0, 0.0, surprise, trusted)


@given(spreads, spreads)
def test_the_farther_the_contours_the_less_typical(first, second):
    near, far = sorted((first, second))
    assert 0.0 <= percentile(far) <= percentile(near) <= 100.0


@given(st.floats(0.0, 6.0), st.floats(0.0, 6.0))
def test_the_less_dense_the_code_the_less_typical(first, second):
    near, far = sorted((first, second))
    codes = [distance * np.array([1.0, 0.0, 0.0]) for distance in (near, far)]
    assert percentile(USUAL, latent=codes[1]) <= percentile(USUAL, latent=codes[0])


@pytest.mark.parametrize("dimensions", [3, 10, 30])
def test_as_many_real_shapes_lie_below_a_percentile_as_it_says(dimensions):
    random = np.random.default_rng(dimensions)
    densities = -0.5 * np.square(random.standard_normal((40_000, dimensions))).sum(axis=1)
    rare = rarity(densities, 0.0)
    tails = 1.0 - ndtr((rare - rare.mean()) / rare.std())
    for share, tolerance in ((0.05, 0.01), (0.01, 0.004), (0.001, 0.0008)):
        assert np.mean(tails < share) == pytest.approx(share, abs=tolerance)


@pytest.mark.parametrize("share", [0.2, 0.05, 0.01])
def test_as_many_real_shapes_lie_below_a_percentile_by_both_figures(share):
    random = np.random.default_rng(7)
    rare, far = random.standard_normal((2, 4000))
    latents = [np.array([np.sqrt(2.0 * max(1.0 + 0.3 * z, 0.0) ** 3), 0.0, 0.0]) for z in rare]
    known = {**KNOWN, "freedom": 1e6, "misfit_exponent": 0.0}
    model = replace(PLAIN, manifest=replace(PLAIN.manifest, typical=known))
    found = [
        typicality(model, replace(FOUND, latent=latent), Figures(5, USUAL * float(np.exp(0.2 * z)), 0.3))[1]
        for latent, z in zip(latents, far, strict=True)
    ]
    assert np.mean(np.array(found) < 100.0 * share) == pytest.approx(share, abs=3.0 * np.sqrt(share / 4000))


def test_two_figures_that_are_both_bad_are_worse_than_either():
    rare, far = (0.0, 0.0, 2.4), USUAL * float(np.exp(0.4))
    assert percentile(far, latent=rare) < 0.5 * min(percentile(far), percentile(USUAL, latent=rare))


def test_the_mean_shape_has_the_density_that_others_are_held_against():
    assert peak_density(PLAIN) == pytest.approx(KNOWN["density_peak"])
    assert rarity(np.array([peak_density(PLAIN)]), peak_density(PLAIN)) == 0.0


def test_a_usual_shape_is_typical_with_any_number_of_planes():
    for planes in (2, 5, 20):
        usual = USUAL * (planes / 5.0) ** 0.1
        assert percentile(usual, planes) > 20.0
        assert typicality_warnings(MODEL, percentile(6.0 * usual, planes)) != ()
        assert typicality_warnings(MODEL, percentile(1.5 * usual, planes)) == ()


def test_of_more_planes_than_were_measured_with_the_misfit_counts_alone():
    far = np.array([6.0, 0.0, 0.0])
    assert typicality_warnings(MODEL, percentile(USUAL, MOST_USUAL_PLANES, latent=far)) != ()
    assert percentile(USUAL, 34, latent=far) > 20.0
    assert typicality_warnings(MODEL, percentile(6.0 * USUAL, 34, latent=far)) != ()
    assert typicality_warnings(MODEL, percentile(0.0, 34, latent=far)) != ()


def test_a_misfit_that_was_not_looked_at_does_not_count():
    assert percentile(0.0, latent=np.zeros(3)) > 40.0
    assert typicality_warnings(MODEL, percentile(0.0, latent=np.array([6.0, 0.0, 0.0]))) != ()


def test_a_plane_that_surprises_is_told_of_unless_it_is_named_elsewhere():
    sections = [section(0.1, 1), section(3.0, 2), section(3.0, 3, trusted=False), section(3.0, 4)]
    chances = predictive_probabilities(MODEL, sections)
    assert chances[0] > 0.1
    assert all(chance < 1e-6 for chance in chances[1:])
    (sentence,) = predictive_warnings(sections, chances, [Plane(0, 2, 4)])
    assert "mask[0] axis 2 index 2" in sentence
    assert "index 3" not in sentence
    assert "index 4" not in sentence


def test_of_many_planes_the_one_that_surprises_more_than_the_others_is_told_of():
    random = np.random.default_rng(1)
    sections = [section(1.0 + random.normal(0.0, 0.3), index) for index in range(40)]
    assert min(predictive_probabilities(MODEL, sections)) > 1e-3
    assert min(predictive_probabilities(MODEL, sections[:MOST_USUAL_PLANES])) < 1e-3
    chances = predictive_probabilities(MODEL, [*sections, section(4.0, 40)])
    assert chances[40] < 1e-3 < min(chances[:40])


def test_a_model_that_was_not_calibrated_does_not_judge_slices():
    sections = [section(3.0)]
    assert predictive_probabilities(PLAIN, sections) == [None]
    assert predictive_warnings(sections, [None], []) == ()


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_labels_drawn_from_the_field_surprise_as_little_as_expected(shift):
    logits = fitted_logits(PLAIN, FOUND, OBSERVATIONS.points + np.array([shift, 0.0, 0.0]))
    random = np.random.default_rng(0).random(len(logits))
    true = fitted_logits(PLAIN, FOUND, OBSERVATIONS.points)
    labelled = replace(OBSERVATIONS, labels=(random < 1.0 / (1.0 + np.exp(-true))).astype(float))
    surprises = [one.surprise for one in sections_of(labelled, logits)]
    assert (max(np.abs(surprises)) < 0.5) == (shift == 0.0)
