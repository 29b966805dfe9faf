"""Draws from the prior: repeatable, as wide as asked for, described truthfully."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import trimesh
from scipy.stats import kstest

from model.errors import InvalidParameter
from model.inference.mesh import components, empty_mesh, is_watertight, mesh_of, volume_ml
from model.inference.plausibility import counted, implausible, volume_range_ml
from model.inference.sampling import MAX_DRAWS, draw_shape
from model.inference.surface import canonical_box
from tests.analytic_model import EllipsoidDecoder, ellipsoid_model

MODEL = ellipsoid_model()
COARSE = 4.0


def analytic_volume(latent):
    return 4.0 / 3.0 * np.pi * np.prod(MODEL.decoder.axes(latent[None])) / 1000.0


def test_a_function_of_the_seed():
    first, second, other = (draw_shape(MODEL, seed) for seed in (11, 11, 12))
    np.testing.assert_array_equal(first.latent, second.latent)
    np.testing.assert_array_equal(first.mesh.vertices, second.mesh.vertices)
    np.testing.assert_array_equal(first.mesh.faces, second.mesh.faces)
    assert (first.log_density, first.nearest_training_distance) == (
        second.log_density,
        second.nearest_training_distance,
    )
    assert not np.allclose(first.latent, other.latent)


@pytest.mark.parametrize("seed", range(8))
def test_mesh_is_that_of_the_code(seed):
    shape = draw_shape(MODEL, seed)
    assert is_watertight(shape.mesh)
    assert volume_ml(shape.mesh) == pytest.approx(analytic_volume(shape.latent), rel=0.03)
    np.testing.assert_allclose(shape.mesh.vertices.mean(axis=0), 0.0, atol=0.3)


def test_codes_follow_the_prior():
    latents = np.array([draw_shape(MODEL, seed, spacing_mm=COARSE, reject=False).latent for seed in range(150)])
    assert kstest(latents.ravel(), "norm").pvalue > 0.01
    np.testing.assert_allclose(np.corrcoef(latents.T), np.eye(3), atol=0.25)


@pytest.mark.parametrize("temperature", [0.1, 0.5, 2.0])
def test_temperature_scales_the_draw(temperature):
    plain = draw_shape(MODEL, 3, spacing_mm=COARSE, reject=False)
    scaled = draw_shape(MODEL, 3, temperature=temperature, spacing_mm=COARSE, reject=False)
    np.testing.assert_allclose(scaled.latent, temperature * plain.latent, rtol=1e-12)


def test_sigmas_scale_the_draw():
    sigmas = (2.0, 0.5, 0.01)
    narrow = replace(MODEL, manifest=replace(MODEL.manifest, sigmas=sigmas))
    plain, scaled = (draw_shape(model, 3, spacing_mm=COARSE, reject=False).latent for model in (MODEL, narrow))
    np.testing.assert_allclose(scaled, plain * sigmas, rtol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_density_and_distance_are_those_of_the_code(seed):
    shape = draw_shape(MODEL, seed, spacing_mm=COARSE)
    density = -0.5 * shape.latent @ shape.latent - 1.5 * np.log(2.0 * np.pi)
    assert shape.log_density == pytest.approx(density)
    distances = [np.sqrt(np.sum((code - shape.latent) ** 2)) for code in MODEL.population.base_codes]
    assert shape.nearest_training_distance == pytest.approx(min(distances))


def test_a_training_code_lies_at_distance_zero():
    base = draw_shape(MODEL, 5, spacing_mm=COARSE).latent
    codes = np.concatenate([base[None], MODEL.population.base_codes[1:]])
    known = replace(MODEL, population=replace(MODEL.population, base_codes=codes))
    assert draw_shape(known, 5, spacing_mm=COARSE).nearest_training_distance == 0.0


def test_dead_dimensions_put_no_distance_between_draws_and_training_codes():
    dead = replace(MODEL, manifest=replace(MODEL.manifest, sigmas=(1.0, 1.0, 1e-4)))
    flat = replace(dead, population=replace(dead.population, base_codes=MODEL.population.base_codes * [1, 1, 0]))
    shape = draw_shape(flat, 8, spacing_mm=COARSE, reject=False)
    expected = np.linalg.norm(MODEL.population.base_codes[:, :2] - shape.latent[:2], axis=1).min()
    assert shape.nearest_training_distance == pytest.approx(expected)


def test_spacing_is_that_of_the_surface():
    fine, coarse = (draw_shape(MODEL, 2, spacing_mm=spacing) for spacing in (0.8, 1.6))
    np.testing.assert_array_equal(fine.latent, coarse.latent)
    assert len(fine.mesh.faces) / len(coarse.mesh.faces) == pytest.approx(4.0, rel=0.15)


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ({"seed": -1}, "seed"),
        ({"temperature": 0.0}, "temperature"),
        ({"temperature": -1.0}, "temperature"),
        ({"temperature": 2.01}, "temperature"),
        ({"temperature": float("nan")}, "temperature"),
        ({"spacing_mm": 0.2}, "spacing_mm"),
        ({"spacing_mm": 10.5}, "spacing_mm"),
        ({"spacing_mm": float("inf")}, "spacing_mm"),
        ({"spacing_mm": float("nan")}, "spacing_mm"),
    ],
)
def test_arguments_out_of_range_are_named(arguments, part):
    with pytest.raises(InvalidParameter) as caught:
        draw_shape(MODEL, **{"seed": 0, **arguments})
    assert caught.value.part == part
    assert part in str(caught.value)
    assert "accepted" in str(caught.value)


@pytest.mark.parametrize("arguments", [{"temperature": 2.0}, {"spacing_mm": 10.0}, {"spacing_mm": 0.25}])
def test_ends_of_the_ranges_are_accepted(arguments):
    assert np.isfinite(draw_shape(MODEL, 0, **arguments).log_density)


def with_volumes(*volumes):
    """The analytic model, its training population of these volumes (mL)."""
    return replace(MODEL, population=replace(MODEL.population, volumes_ml=np.resize(np.array(volumes), 64)))


def test_volumes_out_of_range_are_drawn_anew_from_the_seeds_own_stream():
    """All draws of the stream that leave the range are counted, and the answer is the first that does not."""
    narrow = with_volumes(2.9, 3.2)
    low, high = volume_range_ml(narrow)
    counts = []
    for seed in range(6):
        shape = draw_shape(narrow, seed, spacing_mm=1.5)
        draws = np.random.default_rng(seed).standard_normal((MAX_DRAWS, 3))
        inside = [low <= analytic_volume(draw) <= high for draw in draws]
        first = inside.index(True)
        np.testing.assert_allclose(shape.latent, draws[first])
        assert shape.rejected == ({"volume": first} if first else {})
        assert shape.plausible is True
        counts.append(first)
    assert max(counts) > 0


def test_without_rejection_the_first_draw_stands():
    shape = draw_shape(with_volumes(100.0, 200.0), 4, spacing_mm=COARSE, reject=False)
    np.testing.assert_allclose(shape.latent, np.random.default_rng(4).standard_normal(3))
    assert (shape.rejected, shape.plausible) == ({}, None)


def test_where_nothing_is_plausible_the_last_draw_stands_and_says_so():
    shape = draw_shape(with_volumes(100.0, 200.0), 4, spacing_mm=COARSE)
    np.testing.assert_allclose(shape.latent, np.random.default_rng(4).standard_normal((MAX_DRAWS, 3))[-1])
    assert shape.plausible is False
    assert shape.rejected == {"volume": MAX_DRAWS - 1}


@dataclass(frozen=True)
class TwinDecoder(EllipsoidDecoder):
    """Two ellipsoids beside each other where the first coordinate is positive, one elsewhere."""

    def _nearer(self, latent, points):
        apart = np.where(latent[:, :1] > 0, 16.0, 0.0)
        shifted = points.copy()
        shifted[..., 0] = np.abs(points[..., 0]) - apart
        return shifted

    def logits(self, latent, points):
        return super().logits(latent, self._nearer(latent, points))

    def logits_and_jacobians(self, latent, points):
        return super().logits_and_jacobians(latent, self._nearer(latent, points))


def test_several_components_are_rejected():
    wide = replace(with_volumes(0.1, 10.0), decoder=TwinDecoder(mean_axes=(6.0, 6.0, 6.0)))
    for seed in range(4):
        draws = np.random.default_rng(seed).standard_normal((MAX_DRAWS, 3))
        first = int(np.argmax(draws[:, 0] <= 0))
        shape = draw_shape(wide, seed, spacing_mm=1.5)
        assert shape.rejected == ({"components": first} if first else {})
        assert components(shape.mesh)[0] == 1


def test_the_border_of_the_box_and_emptiness_are_implausible():
    ball = mesh_of(*ball_surface(5.0))
    volumes = with_volumes(0.4, 0.6)
    aside = np.array([canonical_box(MODEL)[0] - 4.0, 0.0, 0.0])
    assert implausible(volumes, ball) is None
    assert implausible(volumes, empty_mesh()) == "empty"
    assert implausible(volumes, replace(ball, vertices=ball.vertices + aside)) == "border"
    assert implausible(MODEL, replace(ball, vertices=0.1 * ball.vertices)) == "volume"


def ball_surface(radius):
    body = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return np.asarray(body.vertices), np.asarray(body.faces)


def test_counts_add_up():
    assert counted([{"volume": 2}, {}, {"volume": 1, "components": 3}]) == {"volume": 3, "components": 3}
