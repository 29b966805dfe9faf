"""Slices that stand for the majority of their thickness."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.geometry import Grid
from model.inference.discrepancy.conditioning import DiscrepancyPrior, discrepancy_of
from model.inference.estimates import sd_of_estimate
from model.inference.fitting import FitOptions, fit
from model.inference.mesh import volume_ml
from model.inference.observations import MaskStack, find_planes, observe
from model.inference.posterior import model_logits
from model.inference.posterior_shapes import draw_posterior
from model.inference.reconstruction import Options, reconstruct
from model.inference.thick_slices import (
    EVEN_RULES,
    MOST_SLICES,
    Columns,
    columns_of,
    decided,
    median_rule,
    settled_under,
    through_thickness,
)
from model.inference.uncertainty import occupancy
from tests.analytic_model import MEAN_AXES, SPREAD, ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import PARALLEL, cube_around, drawn

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
TRUTH = Ellipsoid((13.0, 9.5, 6.5), CENTRE)
TRUTH_MM3 = 4.0 / 3.0 * np.pi * np.prod(TRUTH.semi_axes)
THICKNESS = 5
OPTIONS = FitOptions(robust=False, tolerance=1e-4)


def filled(share, rule):
    """Which columns are foreground of which such a share is filled."""
    return share > 0.5 if rule == "more than half" else share >= 0.5


def thick_stack(thickness=THICKNESS, nodes=45, rule="at least half"):
    """Blocks of slices of 1 mm, averaged and cut at one half; of finer ones where nothing is to be half filled."""
    finer = 9 if rule == "half" else 1
    fine = cube_around(CENTRE, nodes=nodes)
    offsets = fine.affine[:3, 2] * ((np.arange(finer) + 0.5) / finer - 0.5)[:, None]
    parts = [TRUTH.mask(Grid(fine.shape, moved(fine.affine, offset))) for offset in offsets]
    share = np.mean([part.reshape(nodes, nodes, -1, thickness).mean(axis=3) for part in parts], axis=0)
    blocks = filled(share, rule)
    affine = fine.affine.copy()
    affine[:3, 2] *= thickness
    affine[:3, 3] += fine.affine[:3, 2] * (thickness - 1) / 2
    return MaskStack("mask[0]", Grid((nodes, nodes, nodes // thickness), affine), blocks, np.zeros(blocks.shape, bool))


def moved(affine, offset):
    result = affine.copy()
    result[:3, 3] += offset
    return result


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
    columns = columns_of([stack], planes)
    np.testing.assert_allclose(columns.vectors, np.tile([0.0, 0.0, 5.0], (len(planes), 1)))
    assert (columns.counts == 5).all()
    thin = drawn(TRUTH, cube_around(CENTRE), PARALLEL)
    assert columns_of([thin], find_planes([thin], PARALLEL)).rules == ()


@pytest.mark.parametrize(
    ("thickness", "width", "rule", "count"),
    [
        (8.0, 1.0, "at least half", 8),
        (5.0, 0.7, "more than half", 7),
        (5.0, 2.0, "at least half", 2),
        (9.0, 0.3, "at least half", MOST_SLICES),
        (8.0, 1.0, "half", 9),
        (5.0, 0.7, "half", 7),
        (8.0, 1.0, "section", 1),
        (0.0, 1.0, "half", 1),
        (0.0, 1.0, "at least half", 1),
    ],
)
def test_a_thick_slice_averages_slices_as_thick_as_its_voxels_are_wide(thickness, width, rule, count):
    """An odd number of them where none is half filled."""
    assert Columns(np.array([[0.0, thickness, 0.0]]), np.array([width]), rule).counts.tolist() == [count]


@pytest.mark.parametrize(("thickness", "width", "even"), [(8.0, 1.0, True), (3.0, 0.5, True), (5.0, 1.0, False)])
def test_slices_an_even_number_of_voxels_thick_may_have_been_averaged_from_them(thickness, width, even):
    thick, thin = [0.0, thickness, 0.0], [0.0, 0.0, 0.0]
    assert ("at least half" in Columns(np.array([thick, thin]), np.full(2, width)).rules) == even
    uneven = Columns(np.array([[0.0, thickness + 0.3 * width, 0.0], thin]), np.full(2, width))
    assert uneven.rules == ("half", "section")


@settings(max_examples=50)
@given(st.integers(2, MOST_SLICES), st.integers(0, 2**32 - 1), st.sampled_from(["at least half", "more than half"]))
def test_the_deciding_value_has_the_sign_of_the_average_cut_at_one_half(count, seed, rule):
    """Whatever the field does between the slices."""
    random = np.random.default_rng(seed)
    points = random.uniform(-9.0, 9.0, (40, 3))
    columns = Columns(np.tile([0.0, 0.0, float(count)], (40, 1)), np.ones(40), rule)
    waves = random.normal(size=3)
    field = lambda at: np.sin(at @ waves) + 0.3 * np.sin(9.0 * at[:, 2])  # noqa: E731
    places, values = decided(field, points, columns)
    fine = [field(points + (step + 0.5 - count / 2) * np.array([0.0, 0.0, 1.0])) > 0 for step in range(count)]
    np.testing.assert_array_equal(values > 0, filled(np.mean(fine, axis=0), rule))
    np.testing.assert_allclose(field(places), values, atol=1e-12)


def test_thin_and_thick_slices_are_decided_together():
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    for rule, place in (("section", 1.0), ("at least half", 0.5), ("half", 1.0), ("more than half", 1.5)):
        columns = Columns(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 8.0]]), np.ones(2), rule)
        places, values = decided(lambda at: -at[:, 2], points, columns)
        np.testing.assert_allclose(places[:, 2], [1.0, place])
        np.testing.assert_allclose(values, [-1.0, -place])


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
    moved, _ = decided(lambda points: model_logits(MODEL, found, points), observations.points, columns)
    shares = (moved - observations.points)[:, 2] / THICKNESS
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
    assert abs(made.residuals.mean()) < 0.5 * abs(at_centres.mean())
    assert np.square(made.residuals).mean() < 0.7 * np.square(at_centres).mean()


@pytest.mark.parametrize(("thickness", "nodes"), [(3, 45), (4, 44), (5, 45)])
def test_volumes_from_thick_slices_are_those_of_the_shape(thickness, nodes):
    stack = thick_stack(thickness, nodes, "half")
    answer = reconstruct(MODEL, [stack], Options(annotated="nonempty"))
    assert 1000.0 * volume_ml(answer.mesh) == pytest.approx(TRUTH_MM3, rel=0.03)


@pytest.mark.parametrize(("rule", "more"), [("at least half", 0.11), ("half", 0.01), ("more than half", -0.08)])
def test_the_rule_makes_up_for_what_was_drawn_too_much_or_too_little(rule, more):
    """Slices of an even number of voxels draw half a voxel more or less at either end."""
    stack = thick_stack(4, 44, rule)
    assert stack.foreground.sum() * np.prod(stack.grid.spacing) == pytest.approx((1.0 + more) * TRUTH_MM3, rel=0.01)
    observations = observed(stack)
    columns = columns_of([stack], observations.planes)[observations.plane_of]
    settled, _ = settled_under(MODEL, fit(MODEL, observations, OPTIONS), rule, observations, columns, OPTIONS)
    assert settled.thick_rule == rule
    assert 4.0 / 3.0 * np.pi * np.prod(semi_axes(settled)) == pytest.approx(TRUTH_MM3, rel=0.02)


def test_a_rule_that_the_drawing_does_not_tell_makes_intervals_wider():
    """Ellipsoids of all thicknesses are alike."""
    answer, sure = (
        reconstruct(MODEL, [thick_stack(thickness, nodes, "half")], Options(annotated="nonempty"))
        for thickness, nodes in ((4, 44), (5, 45))
    )
    assert answer.volume_ml.low < TRUTH_MM3 / 1000.0 < answer.volume_ml.high
    assert np.diff([answer.volume_ml.low, answer.volume_ml.high]) > 1.5 * np.diff(
        [sure.volume_ml.low, sure.volume_ml.high]
    )
    doubt = answer.state.fits[0].thick_doubt
    np.testing.assert_allclose(doubt[:, :2], 0.0, atol=1e-6)
    assert 0.1 < np.abs(doubt[0, 2]) < 0.6


def test_draws_are_as_open_as_the_interval_where_the_rule_is():
    answer = reconstruct(MODEL, [thick_stack(4, 44, "half")], Options(annotated="nonempty"))
    sure = replace(answer.state, fits=(replace(answer.state.fits[0], thick_doubt=None),))
    open_ml, narrow_ml = (
        np.std([volume_ml(draw_posterior(MODEL, state, seed, 2.0).mesh) for seed in range(24)])
        for state in (answer.state, sure)
    )
    assert open_ml == pytest.approx(sd_of_estimate(answer.volume_ml), rel=0.35)
    assert narrow_ml < 0.75 * open_ml


@pytest.mark.parametrize("uncertainty", ["laplace", "ensemble"])
def test_voxels_beyond_the_ends_are_as_open_as_the_rule_is(uncertainty):
    answer = reconstruct(MODEL, [thick_stack(4, 44, "half")], Options(annotated="nonempty", uncertainty=uncertainty))
    sure = replace(answer.state, fits=(replace(answer.state.fits[0], thick_doubt=None), *answer.state.members))
    beyond = np.diag(TRUTH.semi_axes + np.array([1.0, 1.0, 1.0]))
    grid = Grid((2, 1, 1), cube_around(CENTRE).affine)

    def at(state, place):
        affine = grid.affine.copy()
        affine[:3, 3] = CENTRE + place
        return occupancy(MODEL, state, replace(grid, affine=affine))[0, 0, 0]

    side, _, end = ((at(answer.state, place), at(sure, place)) for place in beyond)
    assert end[0] > 1.2 * end[1] > 0.0
    assert side[0] == pytest.approx(side[1], rel=0.05)


def test_no_doubt_of_the_rule_where_none_would_move_the_ends():
    answer = reconstruct(MODEL, [thick_stack(5, 45)], Options(annotated="nonempty"))
    assert not answer.state.fits[0].thick_doubt.any()
    thin = drawn(TRUTH, cube_around(CENTRE), PARALLEL)
    assert reconstruct(MODEL, [thin], Options(annotated=PARALLEL)).state.fits[0].thick_doubt is None


class TestMedianRule:
    def test_one_that_explains_far_better_is_taken_and_leaves_no_doubt(self):
        for best in ("half", "section", "at least half", "more than half"):
            objectives = {rule: 10.0 + 30.0 * (rule != best) for rule in ("half", "section", *EVEN_RULES)}
            rule, doubt = median_rule(objectives)
            assert rule == best
            assert doubt < 1e-3

    def test_between_two_extremes_the_middle_is_taken_with_the_doubt_of_both(self):
        rule, doubt = median_rule({"half": 1.0, "section": 2.0, "at least half": 1.0, "more than half": 1.0})
        assert rule == "half"
        assert doubt == pytest.approx(np.sqrt(2.0 / (3.0 + np.exp(-1.0))))

    def test_rules_that_end_alike_leave_no_doubt(self):
        assert median_rule({"half": 3.0, "section": 2.0}) == ("section", 0.0)


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
