"""The whole way from drawn planes to the answer."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.bundle import Population
from model.errors import InvalidMask, InvalidParameter, TooLarge
from model.geometry import Grid, Pose
from model.inference.mesh import area_cm2, is_watertight, volume_ml
from model.inference.observations import MaskStack, Plane, section_of
from model.inference.posterior import fitted_jacobians
from model.inference.reconstruction import (
    OBSERVATION_BUDGET,
    UNCALIBRATED,
    Options,
    reconstruct,
)
from model.inference.reliability import Figures
from model.inference.surface import canonical_box
from model.inference.typicality import ATYPICAL_BY_DENSITY, typicality
from tests.analytic_model import EllipsoidDecoder, bent_model, ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import ORTHOGONAL, PARALLEL, DecodedShape, cube_around, drawn, rotation

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL, BENT = ellipsoid_model(), bent_model()
ELLIPSOID = Ellipsoid((14.0, 9.0, 6.0), CENTRE)
#: Code of the shape that is drawn, moved and mirrored.
LATENT = np.array([0.4, 0.3, -0.8])


@dataclass(frozen=True)
class MisleadingDecoder(EllipsoidDecoder):
    """Derivatives that point the wrong way."""

    def logits_and_jacobians(self, latent, points):
        logits, by_latent, by_point = super().logits_and_jacobians(latent, points)
        return logits, -by_latent, -by_point


def reconstructed(stack, model=MODEL, **options):
    return reconstruct(model, [stack], Options(**options))


def distance_to(model, answer, points):
    """First-order distance (mm) of points from a reconstruction's surface."""
    logits, _, by_point = fitted_jacobians(model, answer.state.fits[0], points)
    return np.abs(logits) / np.linalg.norm(by_point, axis=1)


@pytest.mark.parametrize("planes", [ORTHOGONAL, PARALLEL])
@pytest.mark.parametrize("axes", [(14.4, 9.3, 6.3), (10.4, 8.3, 8.3), (12.3, 12.3, 6.4)])
def test_mesh_is_watertight_and_of_the_true_size(axes, planes):
    ellipsoid = Ellipsoid(axes, CENTRE)
    answer = reconstructed(drawn(ellipsoid, cube_around(CENTRE), planes), annotated=planes)
    assert is_watertight(answer.mesh)
    assert volume_ml(answer.mesh) == pytest.approx(ellipsoid.volume_ml, rel=0.03)
    assert area_cm2(answer.mesh) == pytest.approx(ellipsoid.area_cm2, rel=0.02)
    values, gradients = ellipsoid.logits_and_gradients(answer.mesh.vertices)
    assert (np.abs(values) / np.linalg.norm(gradients, axis=1)).max() < 0.25
    assert answer.warnings == ()


def test_answer_describes_itself():
    answer = reconstructed(drawn(ELLIPSOID, cube_around(CENTRE)), annotated=ORTHOGONAL)
    assert answer.planes == ORTHOGONAL
    assert 0 < answer.observation_count <= OBSERVATION_BUDGET
    assert answer.volume_ml.value == volume_ml(answer.mesh)
    assert answer.area_cm2.value == area_cm2(answer.mesh)
    assert [residual.plane for residual in answer.residuals] == list(ORTHOGONAL)
    assert all(residual.disagreement < 0.05 and abs(residual.mean_error) < 0.05 for residual in answer.residuals)
    latent = answer.state.fits[0].latent
    assert answer.log_prior_density == pytest.approx(MODEL.prior.log_density(latent[None])[0][0])


def test_a_coarse_surface_changes_no_figure():
    stack = drawn(ELLIPSOID, cube_around(CENTRE))
    usual, coarse = (reconstructed(stack, annotated=ORTHOGONAL, resolution_mm=step) for step in (None, 4.0))
    assert len(coarse.mesh.vertices) < 0.2 * len(usual.mesh.vertices)
    assert coarse.mesh.scalars["surface_sd_mm"].shape == (len(coarse.mesh.vertices),)
    assert volume_ml(coarse.mesh) < 0.95 * volume_ml(usual.mesh)
    assert (coarse.volume_ml, coarse.area_cm2, coarse.extents) == (usual.volume_ml, usual.area_cm2, usual.extents)
    assert coarse.warnings == usual.warnings


def test_one_section_among_empty_planes_is_answered():
    planes = (Plane(0, 2, 20), *(Plane(0, 2, index) for index in (0, 1, 2, 38, 39, 40)))
    answer = reconstructed(drawn(ELLIPSOID, cube_around(CENTRE), planes), annotated=planes)
    assert answer.volume_ml.value > 0


@pytest.mark.parametrize("option", ["annotated", "uncertainty", "mirror"])
def test_a_rule_that_there_is_not_is_refused_by_name(option):
    options = Options()
    object.__setattr__(options, option, "often")  # as it comes from callers whose types nobody checks
    with pytest.raises(InvalidParameter, match=f"{option} is often; .*are accepted") as error:
        reconstruct(MODEL, [drawn(ELLIPSOID, cube_around(CENTRE))], options)
    assert error.value.part == option


def test_stages_are_told_in_order():
    told = []
    reconstruct(MODEL, [drawn(ELLIPSOID, cube_around(CENTRE))], Options(uncertainty="none"), told.append)
    assert told == ["observations", "fit", "surface", "uncertainty"]


def test_a_refused_option_is_told_before_any_stage():
    told = []
    with pytest.raises(InvalidParameter):
        reconstruct(MODEL, [drawn(ELLIPSOID, cube_around(CENTRE))], Options(resolution_mm=99.0), told.append)
    assert told == []


def test_without_uncertainty_there_are_no_intervals():
    answer = reconstructed(drawn(ELLIPSOID, cube_around(CENTRE)), uncertainty="none")
    assert (answer.volume_ml.low, answer.volume_ml.high) == (None, None)
    assert (answer.area_cm2.low, answer.area_cm2.high) == (None, None)
    assert answer.mesh.scalars == {}
    assert answer.state.covariance is None
    assert answer.state.members == ()


@pytest.mark.parametrize("rule", ["laplace", "ensemble"])
def test_with_uncertainty_intervals_surround_the_figures(rule):
    answer = reconstructed(drawn(ELLIPSOID, cube_around(CENTRE)), uncertainty=rule)
    for estimate in (answer.volume_ml, answer.area_cm2):
        assert 0.0 <= estimate.low < estimate.value < estimate.high
    spread = answer.mesh.scalars["surface_sd_mm"]
    assert spread.shape == (len(answer.mesh.vertices),)
    assert (spread >= 0).all()
    assert 0.01 < spread.max() < 2.0
    assert (answer.state.covariance is None) == (rule == "ensemble")
    assert (UNCALIBRATED in answer.warnings) == (rule == "ensemble")
    assert len(answer.state.members) == (25 if rule == "ensemble" else 0)


def test_uncertainty_does_not_change_the_shape():
    stack = drawn(ELLIPSOID, cube_around(CENTRE))
    meshes = [reconstructed(stack, uncertainty=rule).mesh for rule in ("none", "laplace", "ensemble")]
    for mesh in meshes[1:]:
        np.testing.assert_array_equal(mesh.vertices, meshes[0].vertices)
        np.testing.assert_array_equal(mesh.faces, meshes[0].faces)


@pytest.mark.parametrize("rule", ["laplace", "ensemble"])
def test_same_seed_gives_the_same_bits(rule):
    stack = drawn(ELLIPSOID, cube_around(CENTRE, step=0.5, nodes=81), [Plane(0, axis, 40) for axis in range(3)])
    first, second, other = (reconstructed(stack, uncertainty=rule, seed=seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first.mesh.vertices, second.mesh.vertices)
    np.testing.assert_array_equal(first.mesh.faces, second.mesh.faces)
    np.testing.assert_array_equal(first.mesh.scalars["surface_sd_mm"], second.mesh.scalars["surface_sd_mm"])
    assert (first.volume_ml, first.area_cm2, first.residuals) == (second.volume_ml, second.area_cm2, second.residuals)
    assert other.volume_ml != first.volume_ml


def placed(pose):
    """A bent shape in the world and a grid that is placed with it."""
    grid = cube_around(np.zeros(3))
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = np.linalg.inv(pose.linear), pose.position
    return drawn(DecodedShape(BENT, LATENT, pose), Grid(grid.shape, affine @ grid.affine), PARALLEL)


@settings(max_examples=6)
@given(st.tuples(*[st.floats(-300.0, 300.0)] * 3).map(np.array))
def test_translated_input_gives_the_translated_mesh(shift):
    still, moved = (reconstructed(placed(pose), BENT) for pose in (Pose(), Pose(shift)))
    np.testing.assert_allclose(moved.mesh.vertices, still.mesh.vertices + shift, atol=1e-3)
    assert moved.volume_ml.low == pytest.approx(still.volume_ml.low, rel=1e-5)


def test_mirrored_input_gives_the_mirrored_mesh():
    still = reconstructed(placed(Pose()), BENT)
    mirrored = placed(Pose(mirrored=True))
    for rule in ("always", "auto"):
        answer = reconstructed(mirrored, BENT, mirror=rule)
        assert answer.state.fits[0].pose.mirrored
        np.testing.assert_allclose(answer.mesh.vertices, still.mesh.vertices * [-1, 1, 1], atol=1e-3)
        assert is_watertight(answer.mesh)
        assert volume_ml(answer.mesh) > 0
        assert answer.volume_ml.value == pytest.approx(still.volume_ml.value, rel=1e-5)
    assert distance_to(BENT, reconstructed(mirrored, BENT), still.mesh.vertices * [-1, 1, 1]).max() > 0.5


@pytest.mark.parametrize("degrees", [-20.0, 10.0, 20.0])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0)])
def test_rotated_input_gives_the_rotated_mesh(axis, degrees):
    pose = Pose(CENTRE, rotation(degrees, axis))
    still, turned = (reconstructed(placed(each), BENT) for each in (Pose(), pose))
    back = pose.to_canonical(turned.mesh.vertices)
    assert distance_to(BENT, still, back).max() < 0.6
    assert distance_to(BENT, still, back).mean() < 0.2
    assert turned.volume_ml.value == pytest.approx(still.volume_ml.value, rel=0.02)


@pytest.mark.parametrize("flipped", [0, 1, 2])
def test_direction_of_the_index_axes_makes_no_difference(flipped):
    stack = placed(Pose())
    flip = np.eye(4)
    flip[flipped, flipped], flip[flipped, 3] = -1.0, stack.grid.shape[flipped] - 1.0
    other = replace(
        stack,
        grid=Grid(stack.grid.shape, stack.grid.affine @ flip),
        foreground=np.flip(stack.foreground, flipped),
        excluded=np.flip(stack.excluded, flipped),
    )
    first, second = (reconstructed(each, BENT) for each in (stack, other))
    assert distance_to(BENT, first, second.mesh.vertices).max() < 0.15


def test_two_stacks_are_one_object():
    stacks = [
        drawn(ELLIPSOID, cube_around(CENTRE + shift), [plane])
        for shift, plane in ((0.0, ORTHOGONAL[0]), (3.0, ORTHOGONAL[2]))
    ]
    stacks[1] = replace(stacks[1], part="mask[1]")
    answer = reconstruct(MODEL, stacks, Options())
    assert {plane.stack for plane in answer.planes} == {0, 1}
    assert volume_ml(answer.mesh) == pytest.approx(ELLIPSOID.volume_ml, rel=0.12)


def test_both_ends_of_an_object_are_one_object_however_long_it_is():
    middle = ORTHOGONAL[0].index
    ends = [
        replace(drawn(ELLIPSOID, cube_around(CENTRE), [plane]), part=f"mask[{number}]")
        for number, plane in enumerate((Plane(0, 0, middle - 11), Plane(0, 0, middle + 11)))
    ]
    answer = reconstruct(MODEL, ends, Options())
    assert {plane.stack for plane in answer.planes} == {0, 1}
    assert volume_ml(answer.mesh) == pytest.approx(ELLIPSOID.volume_ml, rel=0.25)


@pytest.mark.parametrize("resolution", [0.0, -1.0, 0.2, 10.1, float("nan"), float("inf")])
def test_resolution_out_of_range_is_refused(resolution):
    with pytest.raises(InvalidParameter, match=r"0\.25 to 10 mm is accepted") as caught:
        reconstructed(drawn(ELLIPSOID, cube_around(CENTRE)), resolution_mm=resolution)
    assert caught.value.part == "resolution_mm"


def test_negative_seed_is_refused():
    with pytest.raises(InvalidParameter, match="seed is -1") as caught:
        reconstructed(drawn(ELLIPSOID, cube_around(CENTRE)), seed=-1)
    assert caught.value.part == "seed"


def test_resolution_is_the_grid_step():
    stack = drawn(ELLIPSOID, cube_around(CENTRE))
    fine, coarse = (reconstructed(stack, resolution_mm=step, uncertainty="none").mesh for step in (0.8, 1.6))
    assert len(fine.faces) / len(coarse.faces) == pytest.approx(4.0, rel=0.15)


def test_empty_mask_is_refused():
    grid = cube_around(CENTRE)
    nothing = np.zeros(grid.shape, bool)
    with pytest.raises(InvalidMask):
        reconstructed(MaskStack("mask[0]", grid, nothing, nothing), annotated="all")


@pytest.mark.parametrize("wrong", range(5))
def test_the_wrong_slice_among_five_is_named(wrong):
    stack = drawn(Ellipsoid((14.0, 10.0, 8.0), CENTRE), cube_around(CENTRE), PARALLEL)
    foreground = stack.foreground.copy()
    section = section_of(foreground, PARALLEL[wrong])
    section[...] = np.roll(section, 12, axis=0)
    answer = reconstructed(replace(stack, foreground=foreground), annotated=PARALLEL)
    apart = [sentence for sentence in answer.warnings if "disagrees" in sentence]
    assert len(apart) == 1
    assert [plane for plane in PARALLEL if f"mask[0] axis 2 index {plane.index}" in apart[0]] == [PARALLEL[wrong]]


@pytest.mark.parametrize("axes", [(24.0, 5.0, 13.0), (20.0, 15.5, 4.0)])
def test_a_shape_unlike_the_population_is_warned_of(axes):
    ellipsoid = Ellipsoid(axes, CENTRE)
    answer = reconstructed(drawn(ellipsoid, cube_around(CENTRE, step=1.5)), annotated=ORTHOGONAL)
    assert answer.typicality_percentile < ATYPICAL_BY_DENSITY
    assert any("unlike the population" in sentence for sentence in answer.warnings)


def test_a_model_of_few_shapes_that_was_not_calibrated_does_not_say_what_is_unlike_them():
    known = MODEL.population
    few = Population(known.codes[:16], known.base_codes[:16], known.log_densities[:16], known.volumes_ml[:16])
    stack = drawn(Ellipsoid((24.0, 5.0, 13.0), CENTRE), cube_around(CENTRE, step=1.5))
    answer = reconstructed(stack, replace(MODEL, population=few), annotated=ORTHOGONAL)
    assert answer.typicality_percentile == 0.0
    assert not any("unlike the population" in sentence for sentence in answer.warnings)


def test_a_fit_that_does_not_converge_is_warned_of():
    model = replace(MODEL, decoder=MisleadingDecoder())
    answer = reconstructed(drawn(Ellipsoid((16.0, 8.0, 5.0), CENTRE), cube_around(CENTRE)), model, uncertainty="none")
    assert answer.warnings[0] == answer.state.fits[0].message
    assert "no damped step lowered the objective" in answer.warnings[0]


def test_typicality_is_the_share_of_the_population_below():
    found = reconstructed(drawn(ELLIPSOID, cube_around(CENTRE)), uncertainty="none").state.fits[0]
    percentiles = []
    for code in MODEL.population.codes:
        density, percentile = typicality(MODEL, replace(found, latent=code), Figures(3, 0.3, 0.3))
        assert density == pytest.approx(-0.5 * code @ code - 1.5 * np.log(2 * np.pi))
        percentiles.append(percentile)
    assert sorted(percentiles) == pytest.approx(100.0 * np.arange(64) / 64)
    assert typicality(MODEL, replace(found, latent=np.zeros(3)), Figures(3, 0.3, 0.3))[1] == 100.0


def test_empty_planes_that_stay_empty_agree():
    planes = tuple(Plane(0, 2, index) for index in (2, 14, 17, 20, 23, 26, 38))
    answer = reconstructed(drawn(ELLIPSOID, cube_around(CENTRE), planes), annotated=planes)
    residuals = {residual.plane.index: residual.disagreement for residual in answer.residuals}
    assert residuals[2] == residuals[38] == 0.0
    assert answer.warnings == ()


@pytest.mark.parametrize("uncertainty", ["none", "laplace"])
def test_the_voxel_limit_holds_at_the_size_that_was_found(uncertainty):
    needed = int(np.prod(np.ceil(2 * canonical_box(MODEL)) + 1))
    options, stack = Options(uncertainty=uncertainty), drawn(ELLIPSOID, cube_around(CENTRE))
    assert not reconstruct(MODEL, [stack], options, max_voxels=2 * needed).mesh.is_empty
    large = replace(stack, grid=Grid(stack.grid.shape, stack.grid.affine @ np.diag([6.0, 6.0, 6.0, 1.0])))
    with pytest.raises(TooLarge, match="times as large as the model's") as refused:
        reconstruct(MODEL, [large], options, max_voxels=2 * needed)
    assert refused.value.part == "resolution_mm"


def test_a_step_too_fine_for_the_models_own_size_is_refused_before_anything_is_done():
    told = []
    with pytest.raises(TooLarge, match="resolution_mm"):
        reconstruct(MODEL, [drawn(ELLIPSOID, cube_around(CENTRE))], Options(resolution_mm=0.5), told.append, 10_000)
    assert told == []
