"""The conditioned process against Gaussian process regression written out."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from model.inference.discrepancy.covariance import Covariance
from model.inference.discrepancy.grouping import cells_of, means_of
from model.inference.discrepancy.levels import Levels
from model.inference.discrepancy.process import NEAREST, Discrepancy
from tests.analytic_shapes import spread_on_a_ball

RANDOM = np.random.default_rng(0)
COVARIANCE = Covariance((0.5, 0.4), (3.0, 9.0))
POINTS = RANDOM.uniform(-12.0, 12.0, (60, 3))
PROCESS = Discrepancy(
    points=POINTS,
    residuals=RANDOM.normal(size=60),
    jacobian=RANDOM.normal(size=(60, 4)),
    covariance=COVARIANCE,
    noise_mm=0.2,
    levels=Levels(3.0),
    half_extent=np.array([16.0, 14.0, 15.0]),
)
PLACES = RANDOM.uniform(-11.0, 11.0, (200, 3))
#: As close to each other as vertices are.
VERTICES = spread_on_a_ball(1500, 11.0)
AREAS = 1.0 + 0.4 * np.sin(VERTICES @ [0.2, 0.1, -0.3])


def written_out(a, b):
    squared = np.square(a[:, None] - b[None]).sum(axis=-1)
    terms = zip(COVARIANCE.sds, COVARIANCE.lengths, strict=True)
    return sum(sd**2 * np.exp(-squared / (2 * length**2)) for sd, length in terms)


GRAM = written_out(POINTS, POINTS) + 0.2**2 * np.eye(60)


def test_covariances_with_chosen_points_are_those_among_all():
    chosen = np.random.default_rng(1).integers(0, len(POINTS), (len(PLACES), 7))
    expected = np.take_along_axis(written_out(PLACES, POINTS), chosen, axis=1)
    np.testing.assert_allclose(COVARIANCE.with_chosen(PLACES, POINTS, chosen), expected, atol=1e-5)


def test_covariance_is_the_sum_of_its_terms():
    np.testing.assert_allclose(COVARIANCE.between(POINTS, PLACES), written_out(POINTS, PLACES), atol=1e-5)
    assert pytest.approx(0.41) == COVARIANCE.variance


def test_sum_on_a_lattice_is_the_sum_at_its_nodes():
    axes = (np.linspace(-3, 3, 4), np.linspace(-2, 5, 5), np.linspace(0, 1, 3))
    weights = RANDOM.normal(size=60)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    expected = (written_out(nodes, POINTS) @ weights).reshape(4, 5, 3)
    np.testing.assert_allclose(COVARIANCE.summed_on(axes, POINTS, weights), expected, atol=1e-4)


def test_mean_is_that_of_regression():
    expected = written_out(PLACES, POINTS) @ np.linalg.solve(GRAM, PROCESS.residuals)
    np.testing.assert_allclose(PROCESS.mean(PLACES), expected, atol=0.02)


def test_what_travels_is_what_it_was_made_of():
    before = PROCESS.mean(PLACES), PROCESS.variance(PLACES)
    travelled = pickle.dumps(PROCESS)
    assert len(travelled) < 2 * sum(values.nbytes for values in (POINTS, PROCESS.residuals, PROCESS.jacobian))
    there = pickle.loads(travelled)
    for here, found in zip(before, (there.mean(PLACES), there.variance(PLACES)), strict=True):
        np.testing.assert_array_equal(here, found)


def test_gradient_is_that_of_the_mean():
    step = 1e-2
    mean, gradient = PROCESS.mean_and_gradient(PLACES)
    np.testing.assert_array_equal(mean, PROCESS.mean(PLACES))
    expected = np.stack(
        [(PROCESS.mean(PLACES + step * axis) - PROCESS.mean(PLACES - step * axis)) / (2 * step) for axis in np.eye(3)],
        axis=1,
    )
    assert np.abs(gradient - expected).max() < 0.02 * np.abs(expected).max()


def test_variance_is_that_of_regression():
    cross = written_out(PLACES, POINTS)
    expected = COVARIANCE.variance - np.einsum("mn,nm->m", cross, np.linalg.solve(GRAM, cross.T))
    np.testing.assert_allclose(PROCESS.variance(PLACES), expected, atol=1e-3)


def test_variance_is_the_prior_far_from_points_and_small_at_them():
    assert PROCESS.variance(np.array([[90.0, 0.0, 0.0]]))[0] == pytest.approx(COVARIANCE.variance)
    assert (PROCESS.variance(POINTS) < 0.2**2).all()


def test_what_a_parameter_moves_is_taken_back_at_the_contours():
    held = replace(PROCESS, noise_mm=1e-3)
    np.testing.assert_allclose(held.carried(POINTS), held.jacobian, atol=0.05)
    assert np.abs(held.carried(np.array([[200.0, 0.0, 0.0]]))).max() < 1e-6


def test_variance_of_a_weighted_sum():
    cross = written_out(VERTICES, POINTS)
    posterior = written_out(VERTICES, VERTICES) - cross @ np.linalg.solve(GRAM, cross.T)
    assert PROCESS.functional_variance(VERTICES, AREAS) == pytest.approx(AREAS @ posterior @ AREAS, rel=0.005)


def test_points_that_were_gathered_before_give_the_same_variance():
    gathered = PROCESS.gathered(VERTICES)
    for weights in (AREAS, VERTICES[:, 0]):
        anew = PROCESS.functional_variance(VERTICES, weights)
        assert PROCESS.functional_variance(VERTICES, weights, gathered) == pytest.approx(anew, rel=1e-9)


def test_variance_of_a_sum_over_few_points_is_exact():
    places, weights = PLACES[:2], np.array([0.7, -1.0])
    cross = written_out(places, POINTS)
    posterior = written_out(places, places) - cross @ np.linalg.solve(GRAM, cross.T)
    assert PROCESS.functional_variance(places, weights) == pytest.approx(weights @ posterior @ weights, rel=0.01)


def test_field_is_the_decoders_where_nothing_was_observed_and_near_its_surface():
    logits = np.linspace(-1.0, 1.0, 20)
    far = np.tile([300.0, 0.0, 0.0], (20, 1))
    np.testing.assert_allclose(PROCESS.corrected(logits, far), logits, atol=0.01)
    assert (np.sign(PROCESS.corrected(50 * logits, far)) == np.sign(logits)).all()


def test_shrinkage_is_the_derivative_by_the_logit():
    logits, far = np.linspace(-20.0, 20.0, 9), np.tile([300.0, 0.0, 0.0], (9, 1))
    change = (PROCESS.corrected(logits + 1e-4, far) - PROCESS.corrected(logits - 1e-4, far)) / 2e-4
    np.testing.assert_allclose(PROCESS.shrinkage(logits), change, atol=1e-6)


def test_cells_hold_their_means_and_keep_kinds_apart():
    cells = cells_of(POINTS, 5.0, np.arange(60) % 2)
    for cell in range(cells.max() + 1):
        members = POINTS[cells == cell]
        assert len(members)
        assert len(set(np.flatnonzero(cells == cell) % 2)) == 1
        np.testing.assert_allclose(means_of(cells, POINTS)[cell], members.mean(axis=0))
        assert np.ptp(members, axis=0).max() <= 5.0


def on_a_cylinder(angles, heights):
    return np.stack([10.0 * np.cos(angles), 10.0 * np.sin(angles), heights], axis=1)


def test_variance_by_the_nearest_contours_is_nearly_that_by_all():
    around, slices = np.meshgrid(np.linspace(0, 2 * np.pi, 42, endpoint=False), np.linspace(-20.0, 20.0, 9))
    points = on_a_cylinder(around.ravel(), slices.ravel())
    turns, heights = np.meshgrid(np.linspace(0, 2 * np.pi, 37, endpoint=False), np.linspace(-22.0, 22.0, 23))
    places = on_a_cylinder(turns.ravel(), heights.ravel())
    assert len(points) > 3 * NEAREST
    moves = np.column_stack([np.ones(len(points)), points / 10.0])
    process = replace(PROCESS, points=points, residuals=np.zeros(len(points)), jacobian=moves)
    cross = written_out(places, points)
    gram = written_out(points, points) + 0.2**2 * np.eye(len(points))
    exact = COVARIANCE.variance - np.einsum("mn,nm->m", cross, np.linalg.solve(gram, cross.T))
    np.testing.assert_allclose(np.sqrt(process.variance(places)), np.sqrt(exact), rtol=0.02)
    carried, variance = process.held(places)
    np.testing.assert_array_equal(variance, process.variance(places))
    assert np.abs(carried - process.carried(places)).max() < 0.05 * np.abs(carried).max()
