"""The augmentation benchmark's parts: classification of separable shapes, strata, areas under curves."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.augmentation import Labelled, area_under_curve, measures_of, score, stratified, synthetic_of
from benchmarks.generator.surfaces import decoded
from tests.analytic_model import ellipsoid_model

MODEL = ellipsoid_model()


def test_the_area_under_the_curve_counts_ordered_pairs():
    scores, positive = np.array([0.1, 0.4, 0.35, 0.8]), np.array([False, False, True, True])
    assert area_under_curve(scores, positive) == pytest.approx(0.75)
    assert area_under_curve(-scores, positive) == pytest.approx(0.25)
    assert area_under_curve(np.zeros(4), positive) == pytest.approx(0.5)


@given(st.integers(10, 60), st.integers(10, 60), st.floats(0.05, 0.9), st.integers(0, 5))
def test_strata_keep_the_share_of_each_class(negatives, positives, share, seed):
    positive = np.arange(negatives + positives) >= negatives
    chosen = stratified(positive, share, seed)
    assert len(set(chosen.tolist())) == len(chosen)
    assert positive[chosen].sum() == max(3, round(share * positives))
    np.testing.assert_array_equal(chosen, stratified(positive, share, seed))


def test_classes_apart_are_told_apart():
    random = np.random.default_rng(0)
    positive = np.arange(80) % 2 == 0
    shapes = Labelled(random.normal(size=(80, 5)) + 4.0 * positive[:, None], positive)
    known = Labelled(shapes.measures[:20], positive[:20])
    unknown = Labelled(shapes.measures[20:], positive[20:])
    assert area_under_curve(score(known, np.ones(20), known, unknown), unknown.positive) > 0.99


def test_synthetic_shapes_of_a_class_resemble_its_members():
    """Codes whose first coordinate is high are long shapes."""
    chosen = np.argsort(MODEL.population.base_codes[:, 0])[-12:]
    long = synthetic_of(MODEL, chosen, True, 20, 0, 2.0)
    typical = measures_of(decoded(MODEL, np.zeros(3), 2.0))
    spread = slice(-3, None)
    assert long.positive.all()
    assert (long.measures[:, spread][:, 0] > typical[spread][0]).mean() > 0.8
