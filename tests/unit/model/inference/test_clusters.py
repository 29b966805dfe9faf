"""Draws follow the clusters of the training codes along one direction, and the base in all others."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest, norm

from model.inference.clusters import MOST_THINNED, Clusters, clusters_of, drawn_base
from model.inference.sampling import BETWEEN, draw_shape
from tests.analytic_model import ellipsoid_model

MODEL = ellipsoid_model()
ALONG = np.array([0.6, 0.0, 0.8])
TWO = Clusters(ALONG, (0.5, 0.5), (-0.92, 0.92), 0.39)
SIGMAS = np.asarray(MODEL.manifest.sigmas)


def manifest_with(clusters):
    return replace(MODEL.manifest, clusters=clusters.as_values())


def draws(clusters, count, temperature=1.0):
    stream = np.random.default_rng(5)
    return np.stack([drawn_base(SIGMAS, clusters, stream, temperature)[0] for _ in range(count)]) / SIGMAS


def mixture_cdf(at, clusters):
    parts = zip(clusters.shares, clusters.means, strict=True)
    return sum(share * norm.cdf(at, mean, clusters.sd) for share, mean in parts)


@pytest.mark.parametrize("clusters", [TWO, Clusters(ALONG, (0.2, 0.8), (-1.7, 0.42), 0.5)])
def test_draws_are_the_mixture_along_the_direction_and_the_base_across_it(clusters):
    found = draws(clusters, 2000)
    assert kstest(found @ ALONG, lambda at: mixture_cdf(at, clusters)).pvalue > 0.01
    across = np.stack([found[:, 1], found @ np.array([0.8, 0.0, -0.6])])
    assert kstest(across.ravel(), "norm").pvalue > 0.01


def test_a_manifest_holds_them_whole():
    found = clusters_of(manifest_with(TWO))
    np.testing.assert_array_equal(found.direction, TWO.direction)
    assert (found.shares, found.means, found.sd) == (TWO.shares, TWO.means, TWO.sd)


def test_one_gaussian_thins_nothing():
    whole = Clusters(ALONG, (0.5, 0.5), (0.0, 0.0), 1.0)
    assert all(whole.kept(row) == pytest.approx(1.0) for row in np.random.default_rng(0).standard_normal((20, 3)))


def test_a_model_of_one_kind_draws_from_its_base():
    assert clusters_of(MODEL.manifest) is None
    expected = SIGMAS * np.random.default_rng(3).standard_normal(3)
    base, thinned = drawn_base(SIGMAS, None, np.random.default_rng(3))
    np.testing.assert_array_equal(base, expected)
    assert thinned == 0


@pytest.mark.parametrize("temperature", [0.5, 2.0])
def test_few_draws_of_any_temperature_lie_between_the_clusters(temperature):
    between = np.mean(np.abs(draws(TWO, 500, temperature) @ ALONG) < 0.2)
    assert between < 0.5 * (2.0 * norm.cdf(0.2 / temperature) - 1.0)


def test_a_gap_that_holds_every_draw_ends_all_the_same():
    nowhere = Clusters(ALONG, (0.5, 0.5), (-5.0, 5.0), 0.01)
    assert drawn_base(SIGMAS, nowhere, np.random.default_rng(0))[1] == MOST_THINNED


def test_samples_count_what_was_thinned_out_and_are_the_seeds_own():
    model = replace(MODEL, manifest=manifest_with(TWO))
    shapes = [draw_shape(model, seed, spacing_mm=4.0) for seed in range(12)]
    assert sum(shape.rejected.get(BETWEEN, 0) for shape in shapes) > 0
    again = draw_shape(model, 7, spacing_mm=4.0)
    np.testing.assert_array_equal(again.latent, shapes[7].latent)
    assert again.rejected == shapes[7].rejected


def test_without_rejection_draws_are_the_bases_own():
    model = replace(MODEL, manifest=manifest_with(TWO))
    for seed in range(4):
        shape, plain = (draw_shape(one, seed, spacing_mm=4.0, reject=False) for one in (model, MODEL))
        np.testing.assert_array_equal(shape.latent, plain.latent)
        assert shape.rejected == {}
