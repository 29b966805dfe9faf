"""Refits under random weights of the planes: many, repeatable, and spread where the drawing leaves room."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from model.geometry import Pose
from model.inference.ensemble import MEMBERS, fit_ensemble
from model.inference.fitting import FitOptions, FitStatus, fit
from model.inference.posterior import laplace_covariance
from tests.analytic_model import EllipsoidDecoder, bent_model, ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import ORTHOGONAL, PARALLEL, DecodedShape, cube_around, drawn, observed

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
OBSERVATIONS = observed(drawn(Ellipsoid((14.0, 8.0, 6.0), CENTRE), cube_around(CENTRE)))
FOUND = fit(MODEL, OBSERVATIONS, FitOptions())


@dataclass(frozen=True)
class ListeningDecoder(EllipsoidDecoder):
    """Keeps every code that it was asked about."""

    heard: list[np.ndarray] = field(default_factory=list)

    def logits_and_jacobians(self, latent, points):
        self.heard.append(latent[0])
        return super().logits_and_jacobians(latent, points)


@pytest.fixture(scope="module")
def members():
    return fit_ensemble(MODEL, OBSERVATIONS, FOUND, seed=1)


def same(first, second):
    return np.array_equal(first.latent, second.latent) and np.array_equal(first.pose.position, second.pose.position)


def test_as_many_as_in_the_paper(members):
    assert len(members) == MEMBERS == 25


def test_a_function_of_the_seed(members):
    again, other = (fit_ensemble(MODEL, OBSERVATIONS, FOUND, seed=seed) for seed in (1, 2))
    assert all(same(a, b) for a, b in zip(members, again, strict=True))
    assert not any(same(a, b) for a, b in zip(members, other, strict=True))


def test_as_many_as_asked_for():
    assert len(fit_ensemble(MODEL, OBSERVATIONS, FOUND, seed=1, members=3)) == 3


def test_members_differ_and_surround_the_fit(members):
    latents = np.array([member.latent for member in members])
    assert len(np.unique(latents, axis=0)) == MEMBERS
    assert all(member.status is FitStatus.CONVERGED for member in members)
    assert (latents.std(axis=0) > 1e-3).all()
    posterior = np.sqrt(np.diag(laplace_covariance(FOUND)))[:3]
    assert (np.abs(latents.mean(axis=0) - FOUND.latent) < 0.5 * posterior).all()


def test_uncertain_where_the_planes_disagree():
    """Planes of one ellipsoid leave the position known; a shifted plane makes it depend on their weights."""
    stack = drawn(Ellipsoid((14.0, 9.0, 7.0), CENTRE), cube_around(CENTRE), PARALLEL)
    foreground = stack.foreground.copy()
    foreground[:, :, 23] = np.roll(foreground[:, :, 23], 4, axis=0)
    spreads = []
    for each in (stack, replace(stack, foreground=foreground)):
        observations = observed(each, PARALLEL)
        found = fit(MODEL, observations, FitOptions(robust=False))
        ensemble = fit_ensemble(MODEL, observations, found, seed=0)
        spreads.append(np.std([member.pose.position[0] for member in ensemble]))
    assert spreads[1] > 5.0 * spreads[0]


def test_members_keep_the_side():
    model = bent_model()
    shape = DecodedShape(model, np.zeros(3), Pose(CENTRE, mirrored=True))
    observations = observed(drawn(shape, cube_around(CENTRE)))
    found = fit(model, observations, FitOptions(mirror="always"))
    assert all(member.pose.mirrored for member in fit_ensemble(model, observations, found, seed=0, members=3))


def test_starts_are_spread_by_half_a_posterior_standard_deviation():
    """About where the weighted planes alone would lead: nowhere, where all planes agree and none weighs more."""
    heard = []
    for seed in range(60):
        decoder = ListeningDecoder()
        one_plane = replace(OBSERVATIONS, planes=OBSERVATIONS.planes[:1], plane_of=0 * OBSERVATIONS.plane_of)
        fit_ensemble(replace(MODEL, decoder=decoder), one_plane, replace(FOUND, plane_weights=None), seed, members=1)
        heard.append(decoder.heard[1])  # the first one is the fit
    expected = 0.5 * np.sqrt(np.diag(laplace_covariance(FOUND)))[:3]
    # Observations are thinned out by the same seed, which moves the optimum a little as well.
    np.testing.assert_allclose(np.std(heard, axis=0), expected, rtol=0.35)


def test_planes_without_observations_are_no_obstacle():
    wider = replace(OBSERVATIONS, planes=(*ORTHOGONAL, *PARALLEL))
    found = replace(FOUND, plane_weights=None)
    assert len(fit_ensemble(MODEL, wider, found, seed=0, members=2)) == 2


def test_planes_that_the_fit_left_out_stay_out():
    found = replace(FOUND, plane_weights=np.array([1.0, 0.0, 1.0]))
    without = replace(OBSERVATIONS, labels=np.where(OBSERVATIONS.plane_of == 1, 0.0, OBSERVATIONS.labels))
    members = [fit_ensemble(MODEL, each, found, seed=0, members=2) for each in (OBSERVATIONS, without)]
    assert all(same(a, b) for a, b in zip(*members, strict=True))
