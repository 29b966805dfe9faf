"""Spread of figures, surfaces and voxels against draws of analytic ellipsoids."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit

from model.geometry import POSE_SIZE, Grid, Pose
from model.inference.discrepancy.conditioning import DiscrepancyPrior, with_discrepancy
from model.inference.estimates import Estimate, interval_reach
from model.inference.fitting import Fit, FitOptions, FitStatus, fit
from model.inference.mesh import (
    Mesh,
    area_cm2,
    area_gradient,
    empty_mesh,
    vertex_areas,
    vertex_normals,
    volume_ml,
)
from model.inference.posterior import (
    fitted_jacobians,
    fitted_logits,
    laplace_covariance,
    logit_variance,
    mean_probability,
)
from model.inference.surface import canonical_box, surface_of
from model.inference.uncertainty import (
    ShapeState,
    area_estimate,
    occupancy,
    surface_spread,
    volume_estimate,
    voxel_entropy,
)
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import PARALLEL, cube_around, drawn, observed, rotation
from tests.posterior_draws import parameter_draws

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
POSE = Pose(CENTRE, rotation(25.0, (1.0, -1.0, 2.0)), 0.1, mirrored=True)
FIT = Fit(np.array([0.8, -0.4, -0.9]), POSE, FitStatus.CONVERGED, "", 1, 0.0, np.eye(3 + POSE_SIZE))
MESH = surface_of(MODEL, FIT.latent, POSE, 0.7)
ELLIPSOID_DRAWN = Ellipsoid((14.0, 9.0, 6.0), CENTRE)
directions = st.tuples(*[st.floats(-3.0, 3.0)] * 3)


def moved(step):
    return replace(FIT, latent=FIT.latent + step[:3], pose=FIT.pose.moved(step[3:]))


def ellipsoid_of(found):
    return Ellipsoid(tuple(MODEL.decoder.axes(found.latent[None])[0] * np.exp(-found.pose.log_scale)))


def covariance_of(**spread):
    """Diagonal, with standard deviations of ``latent``, ``position``, ``rotation`` and ``scale``."""
    deviations = np.full(3 + POSE_SIZE, 1e-9)
    for name, part in (("latent", slice(0, 3)), ("position", slice(3, 6)), ("rotation", slice(6, 9)), ("scale", 9)):
        deviations[part] = spread.get(name, 1e-9)
    return np.diag(deviations**2)


def half_width(estimate: Estimate):
    assert estimate.low is not None
    assert estimate.high is not None
    assert estimate.low <= estimate.value <= estimate.high
    return (estimate.high - estimate.low) / 2.0


def fitted_covariance():
    observations = observed(drawn(Ellipsoid((14.0, 9.0, 6.0), CENTRE), cube_around(CENTRE)))
    return laplace_covariance(fit(MODEL, observations, FitOptions()))


@pytest.mark.parametrize("covariance", [covariance_of(latent=(0.1, 0.2, 0.05), scale=0.01), fitted_covariance()])
def test_intervals_are_those_of_draws_from_the_posterior(covariance):
    spread = surface_spread(MODEL, ShapeState((FIT,), covariance), MESH)
    shapes = [ellipsoid_of(moved(step)) for step in parameter_draws(covariance, 2000, seed=0)]
    for estimate, drawn_figures in (
        (volume_estimate(MESH, spread), [shape.volume_ml for shape in shapes]),
        (area_estimate(MESH, spread), [shape.area_cm2 for shape in shapes]),
    ):
        assert half_width(estimate) == pytest.approx(interval_reach(0.9) * np.std(drawn_figures), rel=0.06)
        low, high = np.quantile(drawn_figures, [0.05, 0.95])
        assert (estimate.low, estimate.high) == pytest.approx((low, high), rel=0.02)


def test_intervals_are_those_of_meshes_of_draws():
    covariance = covariance_of(latent=(0.1, 0.2, 0.05), position=0.5, rotation=0.1, scale=0.01)
    spread = surface_spread(MODEL, ShapeState((FIT,), covariance), MESH)
    fits = [moved(step) for step in parameter_draws(covariance, 100, seed=0)]
    meshes = [surface_of(MODEL, each.latent, each.pose, 1.5) for each in fits]
    for estimate, figure in ((volume_estimate(MESH, spread), volume_ml), (area_estimate(MESH, spread), area_cm2)):
        drawn_sd = np.std([figure(mesh) for mesh in meshes])
        assert half_width(estimate) == pytest.approx(interval_reach(0.9) * drawn_sd, rel=0.15)


def test_surface_spread_of_each_parameter():
    canonical, outward = POSE.to_canonical(MESH.vertices), MESH.normals
    spreads = {
        "position": (0.4 * np.ones(len(outward)), covariance_of(position=0.4)),
        "scale": (0.05 * np.abs(np.sum((MESH.vertices - CENTRE) * outward, axis=1)), covariance_of(scale=0.05)),
        "rotation": (
            0.1 * np.linalg.norm(np.cross(canonical, outward @ POSE.linear.T), axis=1) * np.exp(-2 * POSE.log_scale),
            covariance_of(rotation=0.1),
        ),
    }
    for name, (expected, covariance) in spreads.items():
        spread = surface_spread(MODEL, ShapeState((FIT,), covariance), MESH)
        np.testing.assert_allclose(spread.sd(), expected, rtol=0.01, atol=1e-3, err_msg=name)


def test_moving_a_shape_changes_no_figure():
    covariance = covariance_of(position=1.0, rotation=0.1)
    spread = surface_spread(MODEL, ShapeState((FIT,), covariance), MESH)
    assert half_width(volume_estimate(MESH, spread)) < 2e-3 * volume_ml(MESH)
    assert half_width(area_estimate(MESH, spread)) < 5e-3 * area_cm2(MESH)


def test_ensemble_spread_is_that_of_its_members():
    shifts = np.random.default_rng(0).normal(scale=0.02, size=4)
    members = tuple(
        replace(FIT, pose=Pose(CENTRE + np.array([s, 0.0, 0.0]), POSE.rotation, 0.1, mirrored=True)) for s in shifts
    )
    spread = surface_spread(MODEL, ShapeState((FIT, *members), None), MESH)
    expected = np.std(shifts, ddof=1) * np.abs(MESH.normals[:, 0])
    np.testing.assert_allclose(spread.sd(), expected, rtol=0.02, atol=3e-4)


def test_what_refits_have_in_common_widens_an_ensemble_as_it_widens_laplace():
    wide = replace(MODEL, manifest=replace(MODEL.manifest, posterior={"sd_scale": 1.4, "offset_mm": 0.3}))
    stack = drawn(ELLIPSOID_DRAWN, cube_around(CENTRE), PARALLEL)
    observations = observed(stack, PARALLEL)
    found = fit(MODEL, observations, FitOptions(robust=False))
    found = with_discrepancy(MODEL, found, [stack], observations, DiscrepancyPrior(0.6, 0.5))
    mesh = surface_of(MODEL, found.latent, found.pose, 1.0, found.discrepancy)
    ensemble = surface_spread(wide, ShapeState((found, found, found), None), mesh)
    variance = np.square(1.4 * found.discrepancy.slope) * found.discrepancy.variance(
        found.pose.to_canonical(mesh.vertices)
    )
    slope = np.linalg.norm(fitted_jacobians(MODEL, found, mesh.vertices)[2], axis=1)
    np.testing.assert_allclose(np.square(ensemble.sd()), 0.3**2 + variance / slope**2, rtol=0.02)


def test_ensemble_interval_is_that_of_its_volumes():
    steps = parameter_draws(covariance_of(latent=(0.1, 0.2, 0.05)), 12, seed=3)
    members = tuple(moved(step) for step in steps)
    spread = surface_spread(MODEL, ShapeState((FIT, *members), None), MESH)
    of_members = np.std([ellipsoid_of(member).volume_ml for member in members], ddof=1)
    assert half_width(volume_estimate(MESH, spread)) == pytest.approx(interval_reach(0.9) * of_members, rel=0.1)


def test_no_intervals_without_uncertainty():
    assert surface_spread(MODEL, ShapeState((FIT,), None), MESH) is None
    assert volume_estimate(MESH, None) == Estimate(volume_ml(MESH), None, None)
    assert area_estimate(MESH, None) == Estimate(area_cm2(MESH), None, None)


def test_empty_surface_has_empty_factors():
    spread = surface_spread(MODEL, ShapeState((FIT,), covariance_of(latent=0.1)), empty_mesh())
    assert len(spread.factors) == 0
    assert volume_estimate(empty_mesh(), spread) == Estimate(0.0, 0.0, 0.0)


def test_intervals_do_not_go_below_zero():
    spread = surface_spread(MODEL, ShapeState((FIT,), covariance_of(latent=20.0)), MESH)
    assert volume_estimate(MESH, spread).low == 0.0


def test_area_gradient_against_differences():
    rng = np.random.default_rng(0)
    for number in rng.choice(len(MESH.vertices), 6, replace=False):
        for axis in range(3):
            areas = []
            for side in (1e-4, -1e-4):
                vertices = MESH.vertices.copy()
                vertices[number, axis] += side
                areas.append(area_cm2(Mesh(vertices, MESH.faces, MESH.normals)) * 100.0)
            assert area_gradient(MESH)[number, axis] == pytest.approx((areas[0] - areas[1]) / 2e-4, abs=1e-5)


def test_area_slope_of_a_growing_ball_is_that_of_its_radius():
    ball = surface_of(ellipsoid_model(mean_axes=(10.0, 10.0, 10.0)), np.zeros(3), Pose(), 0.7)
    assert vertex_normals(ball.vertices, ball.faces).shape == ball.normals.shape
    total = np.sum(area_gradient(ball) * ball.normals)
    assert total == pytest.approx(8.0 * np.pi * 10.0, rel=0.02)


@given(st.floats(0.0, 1.0))
def test_entropy_is_bounded_symmetric_and_greatest_at_a_half(probability):
    values = voxel_entropy(np.array([probability, 1.0 - probability, 0.5]))
    assert 0.0 <= values[0] <= np.float32(np.log(2.0))
    assert values[0] == pytest.approx(values[1], abs=1e-6)
    assert values[2] == np.float32(np.log(2.0))
    if abs(probability - 0.5) > 0.01:
        assert values[0] < values[2]


def test_entropy_against_its_definition():
    p = np.linspace(0.01, 0.99, 99).reshape(3, 3, 11)
    np.testing.assert_allclose(voxel_entropy(p), -p * np.log(p) - (1 - p) * np.log(1 - p), rtol=1e-5)
    np.testing.assert_allclose(voxel_entropy(np.array([0.0, 1.0])), 0.0, atol=1e-9)


@st.composite
def grids(draw):
    """Grids near the shape: anisotropic, oblique, flipped or not."""
    turn = rotation(draw(st.floats(-180.0, 180.0)), draw(directions.filter(lambda v: np.linalg.norm(v) > 0.1)))
    spacing = np.array([draw(st.floats(0.5, 6.0)) for _ in range(3)])
    affine = np.eye(4)
    affine[:3, :3] = turn * spacing * [draw(st.sampled_from([-1.0, 1.0])) for _ in range(3)]
    shape = tuple(draw(st.integers(1, 14)) for _ in range(3))
    affine[:3, 3] = CENTRE + np.array(draw(directions)) * 12.0 - affine[:3, :3] @ (np.array(shape) / 2.0)
    return Grid(shape, affine)


def split(grid):
    points = grid.centres()
    canonical = POSE.to_canonical(points)
    distance = np.abs(canonical) - canonical_box(MODEL)
    return points, canonical, distance.max(axis=1)


@settings(max_examples=60)
@given(grids())
def test_occupancy_is_that_of_the_shape_and_zero_outside_the_box(grid):
    values = occupancy(MODEL, ShapeState((FIT,), None), grid)
    assert values.shape == grid.shape
    _, canonical, beyond = split(grid)
    exact = expit(MODEL.decoder.logits(FIT.latent[None], canonical[None])[0])
    flat = values.reshape(-1)
    np.testing.assert_allclose(flat[beyond < -1e-9], exact[beyond < -1e-9], atol=1e-6)
    np.testing.assert_array_equal(flat[beyond > 1e-9], 0.0)


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.5, 0.8])
def test_box_is_filled_to_its_border(offset):
    large = replace(FIT, latent=np.full(3, 12.0), pose=Pose(CENTRE))
    grid = cube_around(CENTRE + offset, nodes=61)
    values = occupancy(MODEL, ShapeState((large,), None), grid).reshape(-1)
    inside = (np.abs(grid.centres() - CENTRE) <= canonical_box(MODEL)).all(axis=1)
    np.testing.assert_array_equal(values > 0.5, inside)


@settings(max_examples=20)
@given(grids())
def test_uncertain_occupancy_is_the_posterior_mean(grid):
    covariance = fitted_covariance() * 9.0
    values = occupancy(MODEL, ShapeState((FIT,), covariance), grid).reshape(-1)
    points, _, beyond = split(grid)
    logits, by_parameter, _ = fitted_jacobians(MODEL, FIT, points)
    exact = np.where(beyond < 0, mean_probability(logits, logit_variance(by_parameter, covariance)), 0.0)
    near = np.abs(logits) < 12.0
    np.testing.assert_allclose(values[near], exact[near], atol=1e-6)
    np.testing.assert_allclose(values[~near & (beyond < 0)], expit(logits[~near & (beyond < 0)]), atol=1e-6)


def test_sharper_probabilities_have_the_same_surface():
    """All move away from one half, none across it."""
    state, grid = ShapeState((FIT,), covariance_of(latent=0.2, position=0.5)), cube_around(CENTRE, step=1.5, nodes=21)
    sharp = replace(MODEL, manifest=replace(MODEL.manifest, posterior={"sharpness": 2.5}))
    before, after = (occupancy(model, state, grid).astype(float) for model in (MODEL, sharp))
    doubted = (before > 0.01) & (before < 0.99)
    assert doubted.sum() > 100
    np.testing.assert_array_equal(after > 0.5, before > 0.5)
    assert (np.abs(after - 0.5) >= np.abs(before - 0.5) - 1e-6).all()
    assert (np.abs(after - 0.5) > np.abs(before - 0.5))[doubted].all()


def test_members_of_an_ensemble_are_not_sharpened():
    """Their logits hold all the doubt that there is within a member."""
    members = tuple(moved(step) for step in parameter_draws(covariance_of(latent=0.2, position=0.5), 2, seed=0))
    state, grid = ShapeState((FIT, *members), None), cube_around(CENTRE, step=2.0, nodes=15)
    sharp = replace(MODEL, manifest=replace(MODEL.manifest, posterior={"sharpness": 2.5}))
    np.testing.assert_array_equal(occupancy(sharp, state, grid), occupancy(MODEL, state, grid))


def test_far_from_the_surface_an_ensemble_is_as_sure_as_its_members():
    """There the fit's label stands for theirs."""
    members = tuple(moved(step) for step in parameter_draws(covariance_of(latent=0.2, position=0.5), 2, seed=0))
    half = canonical_box(MODEL).max()
    grid = Grid(
        (24, 24, 24), np.diag([*[2.0 * half / 23] * 3, 1.0]) + np.pad((CENTRE - half)[:, None], ((0, 1), (3, 0)))
    )
    values = occupancy(MODEL, ShapeState((FIT, *members), None), grid)
    single = np.mean([occupancy(MODEL, ShapeState((member,), None), grid) for member in members], axis=0)
    assert ((values == 0.0) | (values == 1.0)).sum() > 1000
    np.testing.assert_allclose(values, single, atol=1e-3)


def test_ensemble_occupancy_is_the_mean_of_its_members():
    members = tuple(moved(step) for step in parameter_draws(covariance_of(latent=0.3, position=0.5), 3, seed=0))
    grid = cube_around(CENTRE, step=2.0, nodes=15)
    values = occupancy(MODEL, ShapeState((FIT, *members), None), grid).reshape(-1)
    single = [occupancy(MODEL, ShapeState((member,), None), grid).reshape(-1) for member in members]
    inside = split(grid)[2] < -3.0
    assert inside.any()
    np.testing.assert_allclose(values[inside], np.mean(single, axis=0)[inside], atol=1e-6)


def test_grid_far_from_the_shape_is_empty():
    assert not occupancy(MODEL, ShapeState((FIT,), None), cube_around(CENTRE + 500.0, nodes=5)).any()


def test_uncertainty_is_greatest_between_drawn_planes():
    observations = observed(drawn(Ellipsoid((14.0, 9.0, 7.0), CENTRE), cube_around(CENTRE), PARALLEL[:3]), PARALLEL[:3])
    found = fit(MODEL, observations, FitOptions())
    mesh = surface_of(MODEL, found.latent, found.pose, 1.0)
    sd = surface_spread(MODEL, ShapeState((found,), laplace_covariance(found)), mesh).sd()
    drawn_side = mesh.vertices[:, 2] < CENTRE[2]
    assert sd[~drawn_side].max() > 1.5 * sd[drawn_side].max()


def test_calibrated_spread_is_wider_and_shares_an_offset():
    state = ShapeState((FIT,), covariance_of(latent=0.2, position=1.0))
    calibrated = replace(MODEL, manifest=replace(MODEL.manifest, posterior={"sd_scale": 1.5, "offset_mm": 0.3}))
    plain, wide = (surface_spread(model, state, MESH) for model in (MODEL, calibrated))
    np.testing.assert_allclose(wide.sd() ** 2, 2.25 * plain.sd() ** 2 + 0.09, rtol=1e-6)
    # An error that the surface shares moves its volume by its area, whatever else cancels.
    areas = vertex_areas(MESH)
    expected = np.hypot(1.5 * plain.sd_of(areas), 0.3 * areas.sum())
    assert wide.sd_of(areas) == pytest.approx(expected, rel=1e-6)


def held_fit():
    """An ellipsoid, drawn in three planes, that contours hold."""
    stack = drawn(Ellipsoid((14.0, 9.0, 7.0), CENTRE), cube_around(CENTRE))
    observations = observed(stack)
    found = fit(MODEL, observations, FitOptions())
    return with_discrepancy(MODEL, found, [stack], observations, DiscrepancyPrior(0.6, 0.7))


@pytest.mark.parametrize("uncertain", [True, False])
def test_the_background_is_empty_and_the_core_full_though_the_contours_bound_the_field(uncertain):
    found = held_fit()
    state = ShapeState((found,), laplace_covariance(found) if uncertain else None)
    grid = cube_around(CENTRE)
    values = occupancy(MODEL, state, grid).reshape(-1)
    distance = Ellipsoid((14.0, 9.0, 7.0), CENTRE).logits(grid.centres())
    assert values[distance < -8.0].max() < 1e-3
    assert values.sum() == pytest.approx((distance > 0).sum(), rel=0.05)
    near = np.abs(distance) < 1.5
    exact = expit(fitted_logits(MODEL, found, grid.centres()[near]))
    assert np.abs(values[near] - exact).max() < (0.4 if uncertain else 1e-6)


@pytest.mark.parametrize("kind", ["none", "laplace", "ensemble"])
def test_the_memory_of_a_map_is_that_of_its_voxels_and_of_some_layers(kind):
    found = held_fit()
    covariance = laplace_covariance(found) if kind == "laplace" else None
    state = ShapeState((found, found, found) if kind == "ensemble" else (found,), covariance)

    def peak(nodes: int) -> int:
        tracemalloc.start()
        occupancy(MODEL, state, cube_around(CENTRE, step=40.0 / nodes, nodes=nodes))
        taken = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return taken

    assert peak(141) - peak(101) < 30 * (141**3 - 101**3)
