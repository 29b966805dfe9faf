"""Laws of leaving planes out: what it gains, whom it blames, and what it leaves alone."""

from dataclasses import replace

import numpy as np
import pytest

from model.inference.descent import descend
from model.inference.fitting import FitOptions, fit
from model.inference.leave_out import contradicting_plane, leave_out_gains, most_wrong
from model.inference.mask_stack import Plane, section_of
from model.inference.objective import LinearPrior, Objective, Place, reweighted
from model.inference.starts import starting_poses
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import ORTHOGONAL, PARALLEL, cube_around, drawn, observed, rotation

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
ELLIPSOID = Ellipsoid((14.0, 10.0, 8.0), CENTRE)
PLAIN = FitOptions(robust=False)
MIXED = (*ORTHOGONAL, Plane(0, 2, 16), Plane(0, 0, 24))


def stack_with(wrong, planes=PARALLEL, *, shift=9):
    """One plane shifted within itself."""
    stack = drawn(ELLIPSOID, cube_around(CENTRE), planes)
    foreground = stack.foreground.copy()
    if wrong is not None:
        section = section_of(foreground, planes[wrong])
        section[...] = np.roll(section, shift, axis=0)
    return replace(stack, foreground=foreground)


def test_empty_planes_do_not_outvote_those_that_show_the_object():
    few = (Plane(0, 2, 12), Plane(0, 2, 20), *(Plane(0, 2, index) for index in (0, 1, 2, 3, 37, 38, 39)))
    observations = observed(drawn(ELLIPSOID, cube_around(CENTRE), few), few)
    assert most_wrong(observations) == 0
    assert fit(MODEL, observations, FitOptions()).plane_weights.all()


def test_gain_is_that_of_a_refit_to_second_order():
    observations = observed(stack_with(2, shift=2), PARALLEL)
    start = starting_poses(observations, PLAIN)[0]
    found = fit(MODEL, observations, replace(PLAIN, tolerance=1e-8))
    place = Place(found.latent, found.pose)
    terms = Objective(MODEL, observations, start, PLAIN).by_plane(place)
    gains = leave_out_gains(terms, found.precision, np.arange(5))
    for number, gain in enumerate(gains):
        rest = reweighted(observations, (np.arange(5) != number).astype(float))
        refit = descend([Objective(MODEL, rest, start, PLAIN)], [place], 1.0, replace(PLAIN, tolerance=1e-8))[0]
        assert gain == pytest.approx(found.objective - refit.point.value, rel=0.25, abs=0.5)


def test_planes_add_up_to_the_data_term():
    observations = observed(stack_with(None), PARALLEL)
    start = starting_poses(observations, PLAIN)[0]
    found = fit(MODEL, observations, replace(PLAIN, tolerance=1e-8))
    objective, place = Objective(MODEL, observations, start, PLAIN), Place(found.latent, found.pose)
    terms = objective.by_plane(place)
    whole, gathered = objective.at(place.latent, place.pose), objective.gathered(place, terms)
    np.testing.assert_allclose(gathered.value, whole.value, rtol=1e-9)
    np.testing.assert_allclose(gathered.curvature, whole.curvature, atol=1e-5 * np.abs(whole.curvature).max())
    prior = found.objective - sum(term.value for term in terms)
    assert 0.0 <= prior < 0.5 * found.objective
    rest = found.precision - sum(term.curvature for term in terms)
    assert np.linalg.eigvalsh(rest).min() > -1e-6 * np.abs(found.precision).max()


@pytest.mark.parametrize("wrong", range(5))
def test_the_wrong_plane_among_five_is_left_out_of_the_fit(wrong):
    observations = observed(stack_with(wrong), PARALLEL)
    found = fit(MODEL, observations, FitOptions())
    expected = (np.arange(5) != wrong).astype(float)
    np.testing.assert_array_equal(found.plane_weights, expected)
    alone = fit(MODEL, reweighted(observations, expected), PLAIN)
    np.testing.assert_allclose(found.latent, alone.latent, atol=0.05)
    np.testing.assert_allclose(found.pose.position, alone.pose.position, atol=0.1)


@pytest.mark.parametrize("planes", [PARALLEL, MIXED])
@pytest.mark.parametrize("degrees", [0.0, 15.0])
def test_planes_that_agree_are_all_kept(planes, degrees):
    turned = Ellipsoid((14.0, 9.0, 7.0), CENTRE, rotation(degrees, (1.0, 1.0, 0.0)))
    found = fit(MODEL, observed(drawn(turned, cube_around(CENTRE), planes), planes), FitOptions())
    np.testing.assert_array_equal(found.plane_weights, np.ones(len(planes)))


def test_three_planes_are_not_judged():
    observations = observed(stack_with(1, ORTHOGONAL), ORTHOGONAL)
    assert most_wrong(observations) == 0
    np.testing.assert_array_equal(fit(MODEL, observations, FitOptions()).plane_weights, np.ones(3))


def test_planes_without_weight_are_not_judged():
    observations = reweighted(observed(stack_with(3), PARALLEL), np.array([1.0, 1.0, 1.0, 0.0, 1.0]))
    found = fit(MODEL, observations, PLAIN)
    assert contradicting_plane(MODEL, observations, found, starting_poses(observations, PLAIN)[0], PLAIN) is None
    assert most_wrong(observations) == 1


def test_linear_prior_is_the_tangent():
    code = np.array([0.2, -0.4, 0.7])
    nearby = LinearPrior.around(MODEL.prior, code)
    codes = code + np.array([[0.0, 0.0, 0.0], [0.1, 0.0, -0.2]])
    for found, expected in zip(nearby.base_jacobian(codes), MODEL.prior.base_jacobian(codes), strict=True):
        np.testing.assert_allclose(found, expected)
