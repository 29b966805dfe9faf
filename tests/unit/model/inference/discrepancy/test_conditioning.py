"""Shapes that the model's own family does not hold, followed where they were drawn."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from model.inference.discrepancy.conditioning import (
    CELL_MM,
    MOST_POINTS,
    DiscrepancyPrior,
    discrepancy_of,
    with_discrepancy,
)
from model.inference.discrepancy.conditioning import corrected as under
from model.inference.discrepancy.contours import contour_points
from model.inference.discrepancy.grouping import cells_of, means_of
from model.inference.fitting import FitOptions, fit
from model.inference.observations import Plane, find_planes, observe
from model.inference.posterior import fitted_jacobians, fitted_logits, model_logits
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import PARALLEL, cube_around, drawn, rotation

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
GRID = cube_around(CENTRE)
TRUST_SLICES = DiscrepancyPrior(0.8, 1.0, (3.0, 10.0))


@dataclass(frozen=True)
class Bumped:
    """An ellipsoid with a bump of 2 mm on one side, as no code of the model has."""

    height: float = 2.0

    def distance(self, points):
        """About mm, positive inside."""
        local = points - CENTRE
        bump = self.height * np.exp(-np.square(local - np.array([12.0, 0.0, 0.0])).sum(axis=1) / (2 * 4.0**2))
        return 9.0 * (1.0 - np.linalg.norm(local / np.array([12.0, 9.0, 7.0]), axis=1)) + bump

    def mask(self, grid):
        return (self.distance(grid.centres()) > 0).reshape(grid.shape)


SHAPE = Bumped()
STACK = drawn(SHAPE, GRID, PARALLEL)
OBSERVATIONS = observe([STACK], find_planes([STACK], PARALLEL), budget=2500, seed=0)
FOUND = fit(MODEL, OBSERVATIONS, FitOptions(robust=False))


def corrected(prior):
    return with_discrepancy(MODEL, FOUND, [STACK], OBSERVATIONS, prior)


def share_wrong(found, points):
    return np.mean((fitted_logits(MODEL, found, points) > 0) != (SHAPE.distance(points) > 0))


def near_surface(points):
    return points[np.abs(SHAPE.distance(points)) < 2.0]


def test_no_discrepancy_where_the_model_alone_is_trusted():
    assert discrepancy_of(MODEL, FOUND, [STACK], OBSERVATIONS, DiscrepancyPrior(fidelity=0.0)) is None


@pytest.mark.parametrize("fidelity", [0.0, 0.3, 1.0])
def test_another_prior_needs_no_other_observations(fidelity):
    prior = DiscrepancyPrior(0.8, fidelity, (3.0, 10.0))
    anew = discrepancy_of(MODEL, FOUND, [STACK], OBSERVATIONS, prior)
    followed = under(MODEL, corrected(DiscrepancyPrior()), [STACK], OBSERVATIONS, prior).discrepancy
    assert (anew is None) == (followed is None) == (fidelity == 0.0)
    if anew is not None:
        assert (followed.covariance, followed.noise_mm) == (anew.covariance, anew.noise_mm)
        places = CENTRE - FOUND.pose.position + np.random.default_rng(0).uniform(-9.0, 9.0, (50, 3))
        np.testing.assert_array_equal(followed.mean(places), anew.mean(places))
        np.testing.assert_array_equal(followed.variance(places), anew.variance(places))


def test_the_surface_follows_the_drawn_slices():
    drawn_points = OBSERVATIONS.points
    assert share_wrong(corrected(TRUST_SLICES), drawn_points) < 0.5 * share_wrong(FOUND, drawn_points)


def test_and_is_nearer_between_them():
    points = near_surface(cube_around(CENTRE, step=0.7).centres())
    assert share_wrong(corrected(TRUST_SLICES), points) < 0.7 * share_wrong(FOUND, points)


def test_fidelity_leads_from_the_model_to_the_slices():
    points = OBSERVATIONS.points
    wrong = [share_wrong(corrected(replace(TRUST_SLICES, fidelity=value)), points) for value in (0.0, 0.2, 1.0)]
    assert wrong[0] > wrong[1] > wrong[2]


def test_the_surface_is_the_models_away_from_the_slices():
    near = replace(TRUST_SLICES, lengths_mm=(2.0, 4.0))
    one_end = (Plane(0, 2, 14), Plane(0, 2, 17))
    stack = drawn(SHAPE, GRID, one_end)
    found = with_discrepancy(MODEL, FOUND, [stack], observe([stack], one_end, budget=2500, seed=0), near)
    far = CENTRE + np.array([[0.0, 0.0, 7.0]]) + np.random.default_rng(0).normal(scale=0.3, size=(50, 3))
    near_far = np.abs(found.discrepancy.mean(found.pose.to_canonical(far)))
    assert near_far.max() < 0.2 * np.abs(found.discrepancy.residuals).max()


def test_planes_that_the_fit_left_out_are_left_out():
    trusted = np.array([1.0, 1.0, 0.0, 1.0, 1.0])
    points = with_discrepancy(
        MODEL, replace(FOUND, plane_weights=trusted), [STACK], OBSERVATIONS, TRUST_SLICES
    ).discrepancy.points
    index = GRID.to_index(FOUND.pose.to_world(points))[:, 2]
    assert not (np.abs(index - 20) < 0.5).any()
    assert (np.abs(index - 17) < 0.5).any()


def test_a_wrong_side_far_from_every_contour_is_told():
    """A drawing without the part that the fit has: the plane says so although no contour runs there."""
    moved = replace(FOUND, pose=replace(FOUND.pose, position=FOUND.pose.position + np.array([0.0, 6.0, 0.0])))
    found = with_discrepancy(MODEL, moved, [STACK], OBSERVATIONS, TRUST_SLICES)
    assert share_wrong(found, OBSERVATIONS.points) < 0.4 * share_wrong(moved, OBSERVATIONS.points)


def test_a_turned_drawing_gives_the_turned_field():
    turn = rotation(35.0, (1.0, 2.0, -1.0))
    grid = cube_around(CENTRE, turn=turn)
    stack = replace(STACK, grid=grid)
    observations = observe([stack], find_planes([stack], PARALLEL), budget=2500, seed=0)
    pose = replace(
        FOUND.pose, rotation=FOUND.pose.rotation @ turn.T, position=CENTRE + (FOUND.pose.position - CENTRE) @ turn.T
    )
    found = with_discrepancy(MODEL, replace(FOUND, pose=pose), [stack], observations, TRUST_SLICES)
    points = near_surface(GRID.centres())
    expected = fitted_logits(MODEL, corrected(TRUST_SLICES), points)
    turned = fitted_logits(MODEL, found, CENTRE + (points - CENTRE) @ turn.T)
    assert np.quantile(np.abs(turned - expected), 0.99) < 0.12 * np.abs(expected).max()


def test_derivatives_by_point_are_those_of_the_field():
    found, step = corrected(TRUST_SLICES), 1e-2
    points = near_surface(GRID.centres())[::40]
    _, _, by_point = fitted_jacobians(MODEL, found, points)
    for axis, direction in enumerate(np.eye(3)):
        ahead, behind = points + step * direction, points - step * direction
        change = (fitted_logits(MODEL, found, ahead) - fitted_logits(MODEL, found, behind)) / (2 * step)
        np.testing.assert_allclose(by_point[:, axis], change, atol=0.08 * np.abs(by_point).max())


def test_the_contours_hold_the_surface_when_the_code_moves():
    found = corrected(TRUST_SLICES)
    contour = found.pose.to_world(found.discrepancy.points)
    _, alone, _ = fitted_jacobians(MODEL, FOUND, contour)
    _, held, _ = fitted_jacobians(MODEL, found, contour)
    assert np.linalg.norm(held) < 0.25 * np.linalg.norm(alone)


def test_model_logits_know_no_discrepancy():
    points = OBSERVATIONS.points[:50]
    np.testing.assert_array_equal(
        model_logits(MODEL, corrected(TRUST_SLICES), points), model_logits(MODEL, FOUND, points)
    )


@pytest.mark.parametrize("fidelity", [0.0, 0.3, 1.0])
def test_variance_is_divided_between_shape_and_annotator(fidelity):
    prior = DiscrepancyPrior(0.7, fidelity)
    assert prior.covariance.variance == pytest.approx(fidelity * 0.49)
    assert prior.covariance.variance + prior.noise_mm**2 == pytest.approx(0.49, abs=0.011)


def test_many_planes_leave_points_on_the_contours_themselves():
    """A thin shape, drawn on 81 planes a quarter of a millimetre apart: more than are taken."""
    thin = Ellipsoid((12.0, 9.0, 1.5), CENTRE)
    planes = [Plane(0, 0, index) for index in range(16, 105)]
    stack = drawn(thin, cube_around(CENTRE, step=0.25, nodes=121), planes)
    observations = observe([stack], planes, budget=2500, seed=0)
    found = fit(MODEL, observations, FitOptions(robust=False))
    made = discrepancy_of(MODEL, found, [stack], observations, DiscrepancyPrior())
    assert MOST_POINTS / 2 < len(made.points) <= MOST_POINTS
    depths = thin.logits(found.pose.to_world(made.points))
    assert abs(np.mean(depths)) < 0.05
    assert np.quantile(np.abs(depths), 0.95) < 0.3


def test_points_of_few_planes_are_means_of_neighbours():
    made = corrected(DiscrepancyPrior()).discrepancy
    contour, plane_of = contour_points([STACK], OBSERVATIONS.planes)
    canonical = FOUND.pose.to_canonical(contour)
    cells = cells_of(canonical, CELL_MM, plane_of)
    assert len(made.points) == cells.max() + 1
    np.testing.assert_allclose(np.sort(made.points, axis=0), np.sort(means_of(cells, canonical), axis=0), atol=1e-9)
