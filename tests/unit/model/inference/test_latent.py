"""Features are the code's; the way between two codes is straight in the base and ends at both."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.errors import InvalidParameter
from model.geometry import Pose
from model.inference.fitting import Fit, FitStatus
from model.inference.latent import code_between, latent_features, shape_between
from model.inference.mesh import is_watertight, volume_ml
from model.inference.modes import shape_modes
from tests.analytic_model import StandardNormalPrior, ellipsoid_model

MODEL = ellipsoid_model()
SIGMAS = (2.0, 0.5, 1e-5)
UNEQUAL = replace(MODEL, manifest=replace(MODEL.manifest, sigmas=SIGMAS, resolution_mm=2.0))


class CubicPrior(StandardNormalPrior):
    """``z0 = z^3 + z``: a base that is bent against the codes."""

    def to_base(self, latent):
        return latent**3 + latent

    def from_base(self, base):
        roots = [[next(r.real for r in np.roots([1, 0, 1, -v]) if abs(r.imag) < 1e-9) for v in row] for row in base]
        return np.array(roots)


BENT = replace(MODEL, prior=CubicPrior())
CODES = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3).map(np.array)


def fit_of(latent):
    return Fit(np.array(latent), Pose(), FitStatus.CONVERGED, "It ended.", 1, 0.0, np.eye(10))


def test_features_are_those_of_the_code():
    covariance = np.diag(np.arange(1.0, 11.0))
    found = latent_features(UNEQUAL, shape_modes(UNEQUAL), fit_of([1.0, -1.0, 0.0]), covariance)
    np.testing.assert_allclose(found.base, [0.5, -2.0, 0.0])
    np.testing.assert_allclose(found.posterior_sd, np.sqrt([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(found.population_mean, UNEQUAL.population.codes.mean(axis=0))
    np.testing.assert_allclose(found.population_sd, UNEQUAL.population.codes.std(axis=0))
    assert found.active.tolist() == [True, True, False]
    assert latent_features(UNEQUAL, shape_modes(UNEQUAL), fit_of([0.0] * 3), None).posterior_sd is None


@given(CODES, CODES, st.floats(0.0, 1.0))
@settings(max_examples=30)
def test_the_way_is_straight_in_the_base(start, end, at):
    base = BENT.prior.to_base(code_between(BENT, start, end, at)[None])[0]
    expected = (1.0 - at) * BENT.prior.to_base(start) + at * BENT.prior.to_base(end)
    np.testing.assert_allclose(base, expected, atol=1e-6)


@given(CODES, CODES)
@settings(max_examples=10)
def test_the_way_ends_at_both_codes_and_back_is_the_same_way(start, end):
    np.testing.assert_array_equal(code_between(BENT, start, end, 0.0), start)
    np.testing.assert_array_equal(code_between(BENT, start, end, 1.0), end)
    back = code_between(BENT, end, start, 0.75)
    np.testing.assert_allclose(code_between(BENT, start, end, 0.25), back, atol=1e-9)


def test_surfaces_stand_in_the_world_of_the_pose():
    pose = Pose(np.array([40.0, -10.0, 5.0]))
    start, end = np.array([-1.0, 0.0, 0.5]), np.array([1.0, 1.0, -0.5])
    for at in (0.0, 0.4, 1.0):
        mesh = shape_between(MODEL, start, end, pose, at, 1.5)
        axes = MODEL.decoder.axes(((1 - at) * start + at * end)[None])[0]
        assert is_watertight(mesh)
        assert volume_ml(mesh) == pytest.approx(4 / 3 * np.pi * np.prod(axes) / 1000, rel=0.02)
        np.testing.assert_allclose(mesh.vertices.mean(axis=0), pose.position, atol=0.3)


@pytest.mark.parametrize("at", [-0.01, 1.01, float("nan")])
def test_a_place_beyond_the_ends_is_named(at):
    with pytest.raises(InvalidParameter) as caught:
        shape_between(MODEL, np.zeros(3), np.ones(3), Pose(), at)
    assert caught.value.part == "at"
