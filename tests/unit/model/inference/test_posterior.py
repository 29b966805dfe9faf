"""The Laplace posterior where the exact one is known, and its first-order consequences by differences."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import expit
from scipy.stats import norm

from model.geometry import POSE_SIZE, Pose
from model.inference.fitting import Fit, FitOptions, FitStatus, fit
from model.inference.objective import Objective
from model.inference.posterior import (
    CHUNK,
    fitted_jacobians,
    fitted_logits,
    laplace_covariance,
    logit_variance,
    mean_probability,
    normal_displacements,
)
from model.inference.starts import starting_poses
from tests.analytic_model import bent_model, ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import cube_around, drawn, observed, rotation
from tests.posterior_draws import parameter_draws

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = bent_model()
POSE = Pose(CENTRE, rotation(25.0, (1.0, -1.0, 2.0)), 0.1, mirrored=True)
FIT = Fit(np.array([0.3, -0.6, 0.5]), POSE, FitStatus.CONVERGED, "", 1, 0.0, np.eye(3 + POSE_SIZE))


def points_near(count, seed=0):
    return CENTRE + np.random.default_rng(seed).normal(scale=8.0, size=(count, 3))


def moved(step):
    return replace(FIT, latent=FIT.latent + step[:3], pose=FIT.pose.moved(step[3:]))


def random_covariance(size, seed):
    root = np.random.default_rng(seed).normal(size=(size, size))
    return root @ root.T / size + 0.05 * np.eye(size)


@pytest.mark.parametrize("seed", range(5))
def test_linear_gaussian_posterior_is_exact(seed):
    rng = np.random.default_rng(seed)
    design, noise = rng.normal(size=(6, 10)), rng.uniform(0.2, 2.0, 6)
    prior = random_covariance(10, seed)
    exact = prior.copy()
    for row, variance in zip(design, noise, strict=True):
        gain = exact @ row / (row @ exact @ row + variance)
        exact = exact - np.outer(gain, row @ exact)
    found = replace(FIT, precision=np.linalg.inv(prior) + design.T @ (design / noise[:, None]))
    np.testing.assert_allclose(laplace_covariance(found), exact, atol=1e-9)


def test_covariance_of_a_fit_is_symmetric_and_positive():
    model = ellipsoid_model()
    found = fit(model, observed(drawn(Ellipsoid((14.0, 9.0, 6.0), CENTRE), cube_around(CENTRE))), FitOptions())
    covariance = laplace_covariance(found)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-10)
    assert np.linalg.eigvalsh(covariance).min() > 0
    np.testing.assert_allclose(covariance @ found.precision, np.eye(3 + POSE_SIZE), atol=1e-6)


def test_data_narrow_the_prior_in_every_direction():
    model, options = ellipsoid_model(), FitOptions()
    found = fit(model, observed(drawn(Ellipsoid((14.0, 9.0, 6.0), CENTRE), cube_around(CENTRE))), options)
    spreads = [1.0] * 3 + [options.position_sd_mm] * 3 + [options.rotation_sd] * 3 + [options.log_scale_sd]
    gain = np.diag(np.square(spreads)) - laplace_covariance(found)
    assert np.linalg.eigvalsh(gain).min() > -1e-9


def test_laplace_is_close_to_the_posterior():
    """Importance weights of its draws under the objective: all equal if it were exact."""
    model = ellipsoid_model()
    observations = observed(drawn(Ellipsoid((14.0, 9.0, 5.5), CENTRE), cube_around(CENTRE)))
    found = fit(model, observations, FitOptions(tolerance=1e-6))
    objective = Objective(model, observations, starting_poses(observations, FitOptions())[0], FitOptions())
    covariance = laplace_covariance(found)
    draws = parameter_draws(covariance, 300, seed=1)
    exact = np.array([objective.at(found.latent + d[:3], found.pose.moved(d[3:])).value for d in draws])
    assumed = 0.5 * np.einsum("np,pq,nq->n", draws, found.precision, draws)
    weights = np.exp(-(exact - found.objective - assumed))
    assert weights.sum() ** 2 / np.square(weights).sum() > 0.5 * len(draws)
    spread = np.sqrt(np.average(draws**2, axis=0, weights=weights))
    np.testing.assert_allclose(spread, np.sqrt(np.diag(covariance)), rtol=0.25)


def test_logits_are_those_of_the_posed_shape():
    points = points_near(50)
    direct = MODEL.decoder.logits(FIT.latent[None], POSE.to_canonical(points)[None])[0]
    np.testing.assert_allclose(fitted_logits(MODEL, FIT, points), direct, rtol=1e-12)


def test_chunks_make_no_difference():
    points = points_near(CHUNK + 7)
    logits, by_parameter, by_point = fitted_jacobians(MODEL, FIT, points)
    np.testing.assert_array_equal(logits, fitted_logits(MODEL, FIT, points))
    tail = fitted_jacobians(MODEL, FIT, points[-9:])
    for whole, part in zip((logits, by_parameter, by_point), tail, strict=True):
        np.testing.assert_allclose(whole[-9:], part, rtol=1e-12, atol=1e-12)


def test_no_points_give_empty_answers():
    nothing = np.zeros((0, 3))
    assert fitted_logits(MODEL, FIT, nothing).shape == (0,)
    assert [part.shape for part in fitted_jacobians(MODEL, FIT, nothing)] == [(0,), (0, 10), (0, 3)]


def test_jacobian_by_parameters_is_the_difference_quotient():
    points = points_near(40)
    _, by_parameter, _ = fitted_jacobians(MODEL, FIT, points)
    for number, step in enumerate(1e-5 * np.eye(3 + POSE_SIZE)):
        difference = fitted_logits(MODEL, moved(step), points) - fitted_logits(MODEL, moved(-step), points)
        np.testing.assert_allclose(by_parameter[:, number], difference / 2e-5, rtol=1e-5, atol=1e-4)


def test_jacobian_by_points_is_the_difference_quotient():
    points = points_near(40)
    _, _, by_point = fitted_jacobians(MODEL, FIT, points)
    for axis, step in enumerate(1e-5 * np.eye(3)):
        difference = fitted_logits(MODEL, FIT, points + step) - fitted_logits(MODEL, FIT, points - step)
        np.testing.assert_allclose(by_point[:, axis], difference / 2e-5, rtol=1e-5, atol=1e-4)


def test_logit_variance_is_that_of_linear_draws():
    covariance = random_covariance(10, 3)
    _, by_parameter, _ = fitted_jacobians(MODEL, FIT, points_near(12))
    draws = parameter_draws(covariance, 10000, seed=2)
    np.testing.assert_allclose(
        logit_variance(by_parameter, covariance), np.mean((draws @ by_parameter.T) ** 2, axis=0), rtol=0.06
    )


@pytest.mark.parametrize("variance", [0.01, 0.5, 2.0, 10.0, 60.0])
def test_mean_probability_against_quadrature(variance):
    logits = np.linspace(-10.0, 10.0, 9)
    expected = [
        quad(lambda x, m=m: expit(x) * norm.pdf(x, m, variance**0.5), m - 60, m + 60, points=[m, 0.0])[0]
        for m in logits
    ]
    np.testing.assert_allclose(mean_probability(logits, np.full(9, variance)), expected, atol=0.02)


@given(logit=st.floats(-800.0, 800.0), variance=st.floats(0.0, 1e4))
def test_mean_probability_laws(logit, variance):
    both = mean_probability(np.array([logit, -logit]), np.full(2, variance))
    assert both.sum() == pytest.approx(1.0, abs=1e-12)
    assert abs(both[0] - 0.5) <= abs(expit(logit) - 0.5) + 1e-12
    assert mean_probability(np.array([logit]), np.zeros(1))[0] == pytest.approx(expit(logit), abs=1e-12)


@given(logit=st.floats(-80.0, 80.0), variance=st.floats(0.0, 1e3), sharpness=st.floats(0.5, 4.0))
def test_sharpness_multiplies_the_logit(logit, variance, sharpness):
    found = mean_probability(np.array([logit]), np.array([variance]), sharpness)
    scaled = mean_probability(np.array([sharpness * logit]), np.array([sharpness**2 * variance]))
    np.testing.assert_allclose(found, scaled, atol=1e-12)


def test_displacement_follows_the_surface():
    """A point moved outwards by the displacement is on the surface of the moved shape again."""
    model = ellipsoid_model()
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(30, 3))
    axes = model.decoder.axes(FIT.latent[None])[0]
    canonical = directions / np.linalg.norm(directions / axes, axis=1, keepdims=True)
    points = POSE.to_world(canonical)
    _, by_parameter, by_point = fitted_jacobians(model, FIT, points)
    outward = -by_point / np.linalg.norm(by_point, axis=1, keepdims=True)
    for number, step in enumerate(1e-4 * np.eye(3 + POSE_SIZE)):
        shift = normal_displacements(by_parameter, by_point)[:, number] * 1e-4
        logits = fitted_logits(model, moved(step), points + shift[:, None] * outward)
        np.testing.assert_allclose(logits, 0.0, atol=2e-4 * max(1.0, np.abs(shift).max() / 1e-4) * 1e-2)
