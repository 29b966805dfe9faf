"""Draws from the prior: repeatable, as wide as asked for, described truthfully."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from model.errors import InvalidParameter
from model.inference.mesh import is_watertight, volume_ml
from model.inference.sampling import draw_shape
from tests.analytic_model import ellipsoid_model

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
    latents = np.array([draw_shape(MODEL, seed, spacing_mm=COARSE).latent for seed in range(150)])
    assert kstest(latents.ravel(), "norm").pvalue > 0.01
    np.testing.assert_allclose(np.corrcoef(latents.T), np.eye(3), atol=0.25)


@pytest.mark.parametrize("temperature", [0.1, 0.5, 2.0])
def test_temperature_scales_the_draw(temperature):
    plain = draw_shape(MODEL, 3, spacing_mm=COARSE)
    scaled = draw_shape(MODEL, 3, temperature=temperature, spacing_mm=COARSE)
    np.testing.assert_allclose(scaled.latent, temperature * plain.latent, rtol=1e-12)


def test_sigmas_scale_the_draw():
    sigmas = (2.0, 0.5, 0.01)
    narrow = replace(MODEL, manifest=replace(MODEL.manifest, sigmas=sigmas))
    plain, scaled = (draw_shape(model, 3, spacing_mm=COARSE).latent for model in (MODEL, narrow))
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
