"""Reconstructions with a network that completes drawings: what it sees, and what becomes of its answer."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from model.geometry import Pose
from model.inference.completion.completing import PLACED_STEPS, code_logits, completed, trust_in_place, weights_of
from model.inference.discrepancy.conditioning import DiscrepancyPrior
from model.inference.discrepancy.levels import REACH_MM, saturated
from model.inference.fitting import FitOptions, fit
from model.inference.reconstruction import Options, reconstruct
from model.inference.reliability import figures_of
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid, sphere
from tests.completing import LATTICE, BallCompleter, KnownCompleter, completing
from tests.drawn_shapes import ORTHOGONAL, PARALLEL, cube_around, drawn, observed, rotation

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
SHAPE = Ellipsoid((12.0, 9.0, 7.0), CENTRE)
GRID = cube_around(CENTRE)
STACK = drawn(SHAPE, GRID)
OBSERVATIONS = observed(STACK)
FOUND = fit(MODEL, OBSERVATIONS, FitOptions(robust=False))
#: Of the decoder's field at the surface (1/mm), about.
SLOPE = 1.0


def answer(model, stack=STACK, planes=ORTHOGONAL, **options):
    return reconstruct(model, [stack], Options(annotated=planes, **options))


class TestWhatItSees:
    @pytest.mark.parametrize("scale", [1.0, 1.4])
    def test_the_drawing_in_the_fitted_frame_at_the_models_size(self, scale):
        network = KnownCompleter(sphere(9.0).logits)
        found = replace(FOUND, pose=Pose(CENTRE + np.array([0.2, 0.3, 0.15]), rotation(20.0), float(np.log(scale))))
        completed(completing(MODEL, network, 0.5), found, [STACK], OBSERVATIONS, SLOPE)
        inside, outside = (seen.ravel() for seen in network.seen[0])
        gap = SHAPE.logits(found.pose.to_world(LATTICE.points()))
        assert (gap[inside] > -1.0).all()
        assert (gap[outside] < 1.0).all()
        areas = np.pi * (12 * 9 + 12 * 7 + 9 * 7) * scale**2
        assert inside.sum() == pytest.approx(areas - 2 * scale * (12 + 9 + 7), rel=0.1)

    def test_no_plane_that_was_left_out(self):
        network = KnownCompleter(sphere(9.0).logits)
        left = replace(FOUND, plane_weights=np.array([0.0, 1.0, 1.0]))
        for found in (FOUND, left):
            completed(completing(MODEL, network, 0.5), found, [STACK], OBSERVATIONS, SLOPE)
        assert network.seen[1].sum() < network.seen[0].sum()

    def test_the_same_however_object_and_image_lie(self):
        turn = rotation(50.0, (1.0, -1.0, 2.0))
        model = completing(MODEL, BallCompleter(8.5), 0.5)
        placed = cube_around(CENTRE + 100.0, turn=turn)
        elsewhere = drawn(Ellipsoid((12.0, 9.0, 7.0), CENTRE + 100.0, turn), placed)
        one, other = answer(model), answer(model, elsewhere)
        assert other.volume_ml.value == pytest.approx(one.volume_ml.value, rel=0.01)
        back = (other.mesh.vertices - CENTRE - 100.0) @ turn + CENTRE
        gaps = np.abs(SHAPE.logits(back)).mean() - np.abs(SHAPE.logits(one.mesh.vertices)).mean()
        assert abs(gaps) < 0.05


class TestWhatBecomesOfIt:
    def test_nothing_where_there_is_no_network_or_it_has_no_weight_or_finds_nothing(self):
        flat = KnownCompleter(lambda points: np.full(len(points), -3.0))
        steep = KnownCompleter(lambda points: np.minimum(-0.2, sphere(9.0).logits(points) - 10.0))
        broken = KnownCompleter(lambda points: np.where(points[:, 0] > 5.0, np.nan, sphere(9.0).logits(points)))
        without = [completing(MODEL, network, 0.5) for network in (flat, steep, broken)]
        for model in (MODEL, completing(MODEL, BallCompleter(8.0), 0.0), *without):
            assert completed(model, FOUND, [STACK], OBSERVATIONS, SLOPE) is None
        np.testing.assert_array_equal(
            answer(completing(MODEL, BallCompleter(8.0), 0.0)).mesh.vertices, answer(MODEL).mesh.vertices
        )

    def test_its_logits_are_distances_in_mm_however_steep_they_are(self):
        for steepness in (0.5, 4.0):
            network = KnownCompleter(sphere(9.0).logits, steepness=steepness)
            found = completed(completing(MODEL, network, 0.5), FOUND, [STACK], OBSERVATIONS, SLOPE)
            code = MODEL.decoder.logits(FOUND.latent[None], LATTICE.points()[None])[0]
            expected = saturated(sphere(9.0).logits(LATTICE.points())) - saturated(code / SLOPE)
            inner = weights_of(LATTICE).ravel() == 1.0
            np.testing.assert_allclose(found.shifts.ravel()[inner], 0.5 * expected[inner], atol=0.06)

    def test_the_code_is_known_everywhere_as_far_as_it_counts(self):
        everywhere = MODEL.decoder.logits(FOUND.latent[None], LATTICE.points()[None])[0].reshape(LATTICE.voxels)
        found = code_logits(MODEL, FOUND, LATTICE, SLOPE)
        near = np.abs(found) < REACH_MM * SLOPE
        assert 0 < near.sum() < near.size
        np.testing.assert_allclose(found[near], everywhere[near], atol=1e-5)
        gap = np.abs(saturated(found / SLOPE) - saturated(everywhere / SLOPE))
        assert gap[weights_of(LATTICE) > 0.0].max() < 0.05

    def test_it_counts_less_where_the_place_is_not_known(self):
        model = completing(MODEL, BallCompleter(9.0), 0.5)
        known = replace(FOUND, pose=Pose(CENTRE), precision=1e3 * np.eye(10))
        open_by_a_step = replace(known, precision=np.diag([1.0] * 3 + [LATTICE.step_mm**-2] * 3 + [1.0] * 4))
        sure, unsure = (completed(model, found, [STACK], OBSERVATIONS, SLOPE) for found in (known, open_by_a_step))
        np.testing.assert_allclose(unsure.shifts, PLACED_STEPS**2 * sure.shifts, atol=1e-6)
        assert trust_in_place(known, LATTICE) == 1.0

    def test_far_from_the_drawing_the_surface_lies_between_code_and_completion_and_on_it_at_the_contours(self):
        """The network says a ball of 12 mm, where the code says 9 and 7 mm; five planes hold both."""
        stack = drawn(SHAPE, GRID, PARALLEL)
        far = [answer(completing(MODEL, KnownCompleter(sphere(12.0).logits), s), stack, PARALLEL) for s in (0.25, 0.5)]
        plain = answer(MODEL, stack, PARALLEL)
        tops = [found.mesh.vertices[:, 2].max() for found in (plain, *far)]
        assert tops[0] < tops[1] < tops[2] < CENTRE[2] + 12.0
        for found in far:
            drawn_planes = np.abs(found.mesh.vertices[:, 2] - CENTRE[2]) < 0.8
            assert np.abs(SHAPE.logits(found.mesh.vertices[drawn_planes])).mean() < 0.6

    @pytest.mark.parametrize("uncertainty", ["laplace", "ensemble"])
    def test_answers_are_whole(self, uncertainty):
        model = completing(MODEL, BallCompleter(9.0), 0.5)
        found = answer(model, uncertainty=uncertainty)
        assert trimesh.Trimesh(found.mesh.vertices, found.mesh.faces, process=False).is_watertight
        sd = found.mesh.scalars["surface_sd_mm"]
        assert np.isfinite(sd).all()
        assert (sd > 0).all()
        assert found.volume_ml.low < found.volume_ml.value < found.volume_ml.high

    def test_how_far_the_contours_lie_from_the_codes_shape_does_not_change(self):
        """The network sees the drawing and follows it, a wrong one too: its answer must not hide that."""
        model, prior = completing(MODEL, BallCompleter(9.0), 0.75), DiscrepancyPrior(0.6, 0.5)
        alone, with_network = (
            figures_of(one, FOUND, [STACK], OBSERVATIONS, answer(MODEL).mesh, prior) for one in (MODEL, model)
        )
        assert with_network.misfit_mm == pytest.approx(alone.misfit_mm, rel=1e-6)

    def test_trusting_the_model_alone_leaves_the_code(self):
        model = completing(MODEL, BallCompleter(14.0), 0.5)
        np.testing.assert_array_equal(
            answer(model, fidelity=0.0).mesh.vertices, answer(MODEL, fidelity=0.0).mesh.vertices
        )
