"""Draws from the posterior against what the posterior says of itself."""

from dataclasses import replace

import numpy as np
import pytest

from model.inference.discrepancy.draws import drawn as drawn_process
from model.inference.mesh import is_watertight, vertex_areas, volume_ml
from model.inference.posterior import fitted_logits, laplace_covariance
from model.inference.posterior_shapes import draw_posterior
from model.inference.surface import surface_of
from model.inference.uncertainty import ShapeState, surface_spread
from tests.few_planes import MODEL, fitted

DRAWS = 60


def state(fidelity, spread_mm=0.6):
    found = fitted(fidelity, spread_mm)
    return ShapeState((found,), laplace_covariance(found))


def mean_surface(of):
    found = of.fits[0]
    return surface_of(MODEL, found.latent, found.pose, 1.0, found.discrepancy)


@pytest.mark.parametrize("fidelity", [0.0, 0.5])
def test_volumes_of_draws_spread_as_the_interval_says(fidelity):
    posterior = state(fidelity)
    mesh = mean_surface(posterior)
    volumes = [volume_ml(draw_posterior(MODEL, posterior, seed, 1.0).mesh) for seed in range(DRAWS)]
    expected = surface_spread(MODEL, posterior, mesh).sd_of(vertex_areas(mesh)) / 1000.0
    assert np.std(volumes) == pytest.approx(expected, rel=0.35)
    assert np.mean(volumes) == pytest.approx(
        volume_ml(mesh), abs=4.0 * expected / np.sqrt(DRAWS) + 0.02 * volume_ml(mesh)
    )


@pytest.mark.parametrize("fidelity", [0.0, 0.5])
def test_draws_share_the_error_that_all_contours_share(fidelity):
    model = replace(MODEL, manifest=replace(MODEL.manifest, posterior={"sd_scale": 0.2, "offset_mm": 0.5}))
    posterior = state(fidelity)
    mesh = mean_surface(posterior)
    volumes = [volume_ml(draw_posterior(model, posterior, seed, 1.0).mesh) for seed in range(DRAWS)]
    expected = surface_spread(model, posterior, mesh).sd_of(vertex_areas(mesh)) / 1000.0
    assert expected > 0.9 * 0.5 * vertex_areas(mesh).sum() / 1000.0
    assert np.std(volumes) == pytest.approx(expected, rel=0.35)


def test_field_of_draws_spreads_at_the_surface_as_its_sd_says():
    posterior = state(0.5)
    mesh = mean_surface(posterior)
    step = len(mesh.vertices) // 40
    vertices, sd = mesh.vertices[::step], surface_spread(MODEL, posterior, mesh).sd()[::step]
    fits = [draw_posterior(MODEL, posterior, seed, 3.0).fit for seed in range(DRAWS)]
    logits = np.stack([fitted_logits(MODEL, one, vertices) for one in fits])
    moves = logits / posterior.fits[0].discrepancy.slope
    assert np.mean(moves.std(axis=0) / sd) == pytest.approx(1.0, abs=0.3)


def test_draws_are_closed_and_repeatable():
    posterior = state(0.5)
    first, again, other = (draw_posterior(MODEL, posterior, seed, 1.0).mesh for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert is_watertight(first)
    assert first.vertices.shape != other.vertices.shape or not np.allclose(first.vertices, other.vertices)


def test_draws_hold_to_contours_that_are_trusted():
    posterior = state(1.0)
    discrepancy = posterior.fits[0].discrepancy
    contours = posterior.fits[0].pose.to_world(discrepancy.points)
    for seed in range(5):
        found = draw_posterior(MODEL, posterior, seed, 3.0).fit
        off = fitted_logits(MODEL, found, contours) / discrepancy.slope
        assert np.sqrt(np.mean(np.square(off))) < 2.5 * discrepancy.noise_mm + 0.1


def test_draws_of_the_process_have_its_mean_and_variance():
    process = state(0.5).fits[0].discrepancy
    places = np.random.default_rng(3).uniform(-8.0, 8.0, (60, 3))
    fields = np.stack([drawn_process(process, seed).mean(places) for seed in range(300)])
    variance = process.variance(places)
    np.testing.assert_allclose(fields.mean(axis=0), process.mean(places), atol=4.5 * np.sqrt(variance.max() / 300))
    assert np.mean(fields.var(axis=0) / variance) == pytest.approx(1.0, abs=0.15)


def test_draws_of_an_ensemble_are_its_members_each_once():
    found = state(0.0).fits[0]
    members = tuple(replace(found, latent=found.latent + number) for number in range(4))
    posterior = ShapeState((found, *members), None)
    codes = [draw_posterior(MODEL, posterior, seed, 4.0).fit.latent[0] for seed in range(4)]
    assert sorted(codes) == pytest.approx(sorted(one.latent[0] for one in members))


def test_nothing_is_drawn_without_uncertainty():
    found = state(0.0).fits[0]
    with pytest.raises(ValueError, match="without uncertainty"):
        draw_posterior(MODEL, ShapeState((found,), None), 0)
