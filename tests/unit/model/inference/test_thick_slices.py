"""Slices that stand for the majority of their thickness."""

from dataclasses import replace

import numpy as np

from model.geometry import Grid
from model.inference.discrepancy.conditioning import DiscrepancyPrior, discrepancy_of
from model.inference.fitting import FitOptions, fit
from model.inference.observations import MaskStack, find_planes, observe
from model.inference.reconstruction import Options, reconstruct
from model.inference.thick_slices import at_medians, columns_of, through_thickness
from tests.analytic_model import MEAN_AXES, SPREAD, ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import PARALLEL, cube_around, drawn

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
TRUTH = Ellipsoid((13.0, 9.5, 6.5), CENTRE)
THICKNESS = 5
OPTIONS = FitOptions(robust=False, tolerance=1e-4)


def thick_stack(offset=0):
    """Blocks of five slices of 1 mm, averaged and cut at one half."""
    fine = cube_around(CENTRE, nodes=45)
    blocks = TRUTH.mask(fine)[:, :, offset:].reshape(45, 45, -1, THICKNESS).mean(axis=3) >= 0.5
    affine = fine.affine.copy()
    affine[:3, 2] *= THICKNESS
    affine[:3, 3] += fine.affine[:3, 2] * (THICKNESS - 1) / 2
    return MaskStack("mask[0]", Grid((45, 45, 9), affine), blocks, np.zeros(blocks.shape, bool))


def observed(stack):
    return observe([stack], find_planes([stack], "nonempty"), budget=2500, seed=0)


def true_fit(observations):
    found = fit(MODEL, observations, OPTIONS)
    pose = replace(found.pose, position=CENTRE, rotation=np.eye(3), log_scale=0.0)
    return replace(found, latent=np.log(np.divide(TRUTH.semi_axes, MEAN_AXES)) / SPREAD, pose=pose)


def semi_axes(found):
    return MODEL.decoder.axes(found.latent[None])[0] * np.exp(-found.pose.log_scale)


def test_columns_are_the_thickness_of_thick_slices_alone():
    stack = thick_stack()
    planes = find_planes([stack], "nonempty")
    np.testing.assert_allclose(columns_of([stack], planes), np.tile([0.0, 0.0, 5.0], (len(planes), 1)))
    thin = drawn(TRUTH, cube_around(CENTRE), PARALLEL)
    assert not columns_of([thin], find_planes([thin], PARALLEL)).any()


def test_thin_slices_are_left_as_they_are():
    stack = drawn(TRUTH, cube_around(CENTRE), PARALLEL)
    observations = observe([stack], find_planes([stack], PARALLEL), budget=2500, seed=0)
    found = fit(MODEL, observations, OPTIONS)
    assert through_thickness(MODEL, found, [stack], observations, OPTIONS) == (found, observations)


def test_an_observation_stands_where_the_field_takes_its_median():
    stack = thick_stack()
    observations = observed(stack)
    found = fit(MODEL, observations, OPTIONS)
    columns = columns_of([stack], observations.planes)[observations.plane_of]
    moved = at_medians(MODEL, found, observations, columns)
    shares = (moved.points - observations.points)[:, 2] / THICKNESS
    assert set(np.round(shares, 6)) <= {-0.4, -0.2, 0.0, 0.2, 0.4}
    apex = np.abs(stack.grid.to_index(observations.points)[:, 2] - 4) < 0.1
    assert (np.abs(shares[~apex]) < 0.05).mean() > 0.8, "the field falls evenly through slices off the middle"
    assert (np.abs(shares[apex]) > 0.1).any(), "and has its peak within the middle one"


def test_the_majority_tells_the_shape_better_than_the_centre():
    stack = thick_stack()
    observations = observed(stack)
    centred = fit(MODEL, observations, OPTIONS)
    settled, _ = through_thickness(MODEL, centred, [stack], observations, OPTIONS)
    errors = [np.abs(semi_axes(found) - TRUTH.semi_axes).sum() for found in (centred, settled)]
    assert errors[1] <= errors[0] + 0.05


def test_contours_of_thick_slices_ask_little_of_the_shape_that_was_drawn():
    """The whole object fills half of a slice's thickness elsewhere than its section at the slice's centre ends."""
    stack = thick_stack()
    observations = observed(stack)
    truth = true_fit(observations)
    made = discrepancy_of(MODEL, truth, [stack], observations, DiscrepancyPrior())
    logits = MODEL.decoder.logits(truth.latent[None], made.points[None])[0]
    at_centres = -made.levels.at(logits, made.points)
    assert abs(made.residuals.mean()) < 0.75 * abs(at_centres.mean())
    assert np.square(made.residuals).mean() < 0.8 * np.square(at_centres).mean()


def test_contours_of_thin_slices_run_in_them():
    stack = drawn(TRUTH, cube_around(CENTRE), PARALLEL)
    observations = observe([stack], find_planes([stack], PARALLEL), budget=2500, seed=0)
    truth = true_fit(observations)
    made = discrepancy_of(MODEL, truth, [stack], observations, DiscrepancyPrior())
    logits = MODEL.decoder.logits(truth.latent[None], made.points[None])[0]
    np.testing.assert_array_equal(made.residuals, -made.levels.at(logits, made.points))


def test_planes_that_were_left_out_stay_out():
    stack = thick_stack()
    observations = observed(stack)
    trust = np.ones(len(observations.planes))
    trust[0] = 0.0
    found = replace(fit(MODEL, observations, OPTIONS), plane_weights=trust)
    settled, _ = through_thickness(MODEL, found, [stack], observations, OPTIONS)
    np.testing.assert_array_equal(settled.plane_weights, trust)


def test_the_drawing_corrects_members_of_an_ensemble_in_its_own_planes():
    """What is drawn stands in the slice's middle, wherever the fit placed the observations."""
    stack = thick_stack()
    foreground = stack.foreground.copy()
    foreground[28:40, 14:30, 4] = True
    lobed = replace(stack, foreground=foreground)
    answer = reconstruct(MODEL, [lobed], Options(annotated="nonempty", uncertainty="ensemble"))
    for found in answer.state.fits:
        index = stack.grid.to_index(found.pose.to_world(found.discrepancy.points))[:, 2]
        np.testing.assert_allclose(index, np.rint(index), atol=1e-6)
