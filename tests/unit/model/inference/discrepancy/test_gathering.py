"""Weighted sums of a process over points on lattices against the sums written out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.inference.discrepancy.covariance import Covariance
from model.inference.discrepancy.gathering import GatheredPoints
from tests.analytic_shapes import spread_on_a_ball

COVARIANCE = Covariance((0.5, 0.4), (2.0, 8.0))


def sheet(tilt):
    """Points 1 mm apart on a plane that leans by so much (rad), and weights that change along it."""
    along = np.linspace(-12.0, 12.0, 25)
    first, second = (values.ravel() for values in np.meshgrid(along, along))
    points = np.stack([first, second * np.cos(tilt), second * np.sin(tilt) + 0.37], axis=1)
    return points, 1.0 + 0.8 * np.sin(points @ [0.3, -0.2, 0.1])


def ball():
    """Points spread evenly on a ball of 11 mm, and areas that differ."""
    points = spread_on_a_ball(1500, 11.0)
    return points, 1.0 + 0.4 * np.sin(points @ [0.2, 0.1, -0.3])


def agrees(points, weights):
    gathered = GatheredPoints.of(COVARIANCE, points)
    written_out = weights @ COVARIANCE.between(points, points).astype(float) @ weights
    assert gathered.variance_of(weights) == pytest.approx(written_out, rel=2e-3)
    places = points[::7] + 0.4
    expected = COVARIANCE.between(places, points).astype(float) @ weights
    found = gathered.covariances_with(places, weights)
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


def test_sums_over_a_closed_surface():
    agrees(*ball())


@given(st.floats(0.0, np.pi / 2))
def test_sums_over_a_sheet_however_it_leans(tilt):
    """In a cell, points of a sheet are not spread as those of a cloud are."""
    agrees(*sheet(tilt))


@given(st.integers(1, 40), st.integers(0, 10_000))
def test_weights_stay_where_their_points_are(count, seed):
    """Total and first moment of the gathered weights are those of the points."""
    random = np.random.default_rng(seed)
    points, weights = random.uniform(-20.0, 20.0, (count, 3)), random.uniform(0.1, 1.0, count)
    for lattice in GatheredPoints.of(COVARIANCE, points).lattices:
        gathered = lattice.gathered(weights).astype(float)
        assert gathered.sum() == pytest.approx(weights.sum(), rel=1e-5)
        nodes = np.stack(np.meshgrid(*lattice.axes, indexing="ij"), axis=-1)
        np.testing.assert_allclose((gathered[..., None] * nodes).sum(axis=(0, 1, 2)), weights @ points, atol=1e-3)


def test_places_far_away_share_nothing():
    points, weights = ball()
    assert np.abs(GatheredPoints.of(COVARIANCE, points).covariances_with(points + 200.0, weights)).max() < 1e-9
