"""Modes: measured on the surface, ranked, summing to one; surfaces along them are those of their codes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.bundle import open_bundle
from model.errors import InvalidParameter, UnknownMode
from model.inference.mesh import is_watertight, volume_ml
from model.inference.modes import (
    DISPLACEMENT,
    FARTHEST_SD,
    TO_MEAN,
    base_directions,
    code_along,
    displacements,
    shape_along,
    shape_modes,
)
from tests.analytic_model import SPREAD, ellipsoid_model

BALL = ellipsoid_model("ball", (10.0, 10.0, 10.0))
MODEL = ellipsoid_model()
MODES = shape_modes(MODEL)


def with_sigmas(*sigmas):
    """The analytic model with other deviations, its own grid coarse."""
    return replace(MODEL, manifest=replace(MODEL.manifest, sigmas=sigmas, resolution_mm=3.0))


UNEQUAL = with_sigmas(2.0, 0.5, 1.0)
UNEQUAL_MODES = shape_modes(UNEQUAL)


def test_a_balls_axes_move_it_alike_and_as_geometry_says():
    """A ball's point with normal n moves by R s n_i^2 to first order; the mean of n_i^4 over the sphere is 1/5."""
    found = shape_modes(BALL)
    expected = 10.0 * SPREAD / np.sqrt(5.0)
    assert [mode.displacement_mm_per_sd for mode in found.ranked] == pytest.approx([expected] * 3, rel=0.06)
    assert [mode.variance_explained for mode in found.ranked] == pytest.approx([1 / 3] * 3, rel=0.03)


@given(st.lists(st.floats(0.01, 3.0), min_size=3, max_size=3))
@settings(max_examples=10, deadline=None)
def test_shares_sum_to_one_in_falling_order_over_every_dimension(sigmas):
    found = shape_modes(with_sigmas(*sigmas))
    moves = [mode.displacement_mm_per_sd for mode in found.ranked]
    assert moves == sorted(moves, reverse=True)
    assert sorted(mode.dimension for mode in found.ranked) == [0, 1, 2]
    assert [mode.rank for mode in found.ranked] == [1, 2, 3]
    squares = np.square(moves)
    np.testing.assert_allclose([m.variance_explained for m in found.ranked], squares / squares.sum(), rtol=1e-9)
    np.testing.assert_allclose([m.cumulative_variance for m in found.ranked], np.cumsum(squares) / squares.sum())
    assert [mode.sigma for mode in found.ranked] == [sigmas[mode.dimension] for mode in found.ranked]


def test_the_longest_axis_moves_most_at_equal_sigma():
    assert [mode.dimension for mode in MODES.ranked] == [0, 1, 2]


def test_a_dimension_without_spread_is_last_and_counts_for_nothing():
    found = shape_modes(with_sigmas(1e-6, 1.0, 1.0))
    assert found.ranked[-1].dimension == 0
    assert found.ranked[-1].variance_explained < 1e-9
    assert found.active() == (2, 2, 2)


@given(st.dictionaries(st.integers(1, 3), st.floats(-FARTHEST_SD, FARTHEST_SD), max_size=3))
@settings(max_examples=20, deadline=None)
def test_coordinates_are_deviations_in_the_base(coordinates):
    base = UNEQUAL.prior.to_base(code_along(UNEQUAL, UNEQUAL_MODES, coordinates)[None])[0]
    for mode in UNEQUAL_MODES.ranked:
        assert base[mode.dimension] == pytest.approx(coordinates.get(mode.rank, 0.0) * mode.sigma)


@pytest.mark.parametrize("sd", [-2.0, 0.0, 1.5])
def test_the_surface_is_that_of_the_code(sd):
    mesh = shape_along(MODEL, MODES, {1: sd})
    axes = MODEL.decoder.axes(code_along(MODEL, MODES, {1: sd})[None])[0]
    assert is_watertight(mesh)
    assert volume_ml(mesh) == pytest.approx(4.0 / 3.0 * np.pi * np.prod(axes) / 1000.0, rel=0.01)


@pytest.mark.parametrize(("rank", "sd"), [(1, 0.0), (2, 1.0), (3, -1.5)])
def test_displacement_is_the_derivative_of_the_surface_along_its_normal(rank, sd):
    """Vertices moved along the normal by displacement times a small step lie on the surface of the next shape."""
    step = 0.02
    mesh = shape_along(MODEL, MODES, {rank: sd})
    moved = mesh.vertices + step * mesh.scalars[DISPLACEMENT][:, None] * mesh.normals
    axes = MODEL.decoder.axes(code_along(MODEL, MODES, {rank: sd + step})[None])[0]
    off = np.abs(np.linalg.norm(moved / axes, axis=1) - 1.0) * axes.min()
    assert off.max() < 0.1 * step * np.abs(mesh.scalars[DISPLACEMENT]).max()


def test_distance_to_the_mean_has_its_sign_and_size():
    modes = shape_modes(BALL)
    small, mean, large = (shape_along(BALL, modes, {1: t, 2: t, 3: t}) for t in (-1.0, 0.0, 1.0))
    np.testing.assert_allclose(mean.scalars[TO_MEAN], 0.0, atol=1e-6)
    np.testing.assert_allclose(large.scalars[TO_MEAN], 10.0 * (np.exp(SPREAD) - 1.0), atol=0.05)
    np.testing.assert_allclose(small.scalars[TO_MEAN], 10.0 * (np.exp(-SPREAD) - 1.0), atol=0.05)
    assert DISPLACEMENT not in large.scalars


@pytest.fixture(scope="module")
def random_model(exported):
    return open_bundle(exported.folder, threads=1)


def test_directions_are_derivatives_through_the_flow(random_model):
    rng, sigmas = np.random.default_rng(2), np.asarray(random_model.manifest.sigmas)
    base = sigmas * rng.normal(size=3)
    latent = random_model.prior.from_base(base[None])[0]
    step = 1e-3
    ends = random_model.prior.from_base(np.concatenate([base + step * np.diag(sigmas), base - step * np.diag(sigmas)]))
    differences = (ends[:3] - ends[3:]).T / (2.0 * step)
    np.testing.assert_allclose(
        base_directions(random_model, latent), differences, atol=0.02 * np.abs(differences).max()
    )


def test_displacements_of_many_points_are_those_of_each(random_model):
    rng = np.random.default_rng(0)
    points, latent = rng.uniform(-10, 10, (40, 3)), rng.normal(size=3)
    whole = displacements(random_model, latent, points, np.eye(3))
    single = np.concatenate([displacements(random_model, latent, point[None], np.eye(3)) for point in points])
    np.testing.assert_allclose(whole, single, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("rank", [0, 4, -1])
def test_a_rank_that_is_not_there_is_unknown(rank):
    with pytest.raises(UnknownMode, match="from 1 to 3 are accepted"):
        code_along(MODEL, MODES, {rank: 1.0})


@pytest.mark.parametrize("sd", [5.01, -6.0, float("nan"), float("inf")])
def test_coordinates_too_far_out_are_named(sd):
    with pytest.raises(InvalidParameter) as caught:
        code_along(MODEL, MODES, {1: sd})
    assert caught.value.part == "sd"


@pytest.mark.parametrize("spacing", [0.2, 11.0, float("nan")])
def test_a_grid_step_out_of_range_is_named(spacing):
    with pytest.raises(InvalidParameter) as caught:
        shape_along(MODEL, MODES, {}, spacing)
    assert caught.value.part == "spacing_mm"


def test_a_code_without_a_surface_is_told():
    nowhere = replace(MODEL, decoder=replace(MODEL.decoder, mean_axes=(1e-3, 1e-3, 1e-3)))
    with pytest.raises(InvalidParameter, match="no surface"):
        shape_along(nowhere, MODES, {1: 0.0})
    with pytest.raises(InvalidParameter, match="no surface"):
        shape_modes(nowhere)
