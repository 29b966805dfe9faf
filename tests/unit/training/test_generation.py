import numpy as np
import pytest

from model.inference.mesh import mesh_of
from tests.analytic_model import ellipsoid_model
from training.generation import Generation, generated, surface_distance


def sphere(radius, subdivisions=4):
    import trimesh

    found = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return mesh_of(np.asarray(found.vertices, float), np.asarray(found.faces, np.int64))


@pytest.mark.parametrize("gap", [0.0, 0.5, 3.0])
def test_distance_of_concentric_spheres_is_the_difference_of_their_radii(gap):
    assert surface_distance(sphere(20.0), sphere(20.0 + gap)) == pytest.approx(gap, abs=0.03)
    assert surface_distance(sphere(20.0 + gap), sphere(20.0)) == pytest.approx(gap, abs=0.03)


def test_a_line_has_correlation_one_and_noise_nearly_none():
    latent = np.linspace(0.0, 3.0, 50)
    assert Generation(latent, 2.0 * latent + 1.0).r_squared == pytest.approx(1.0)
    assert Generation(latent, -latent).pearson == pytest.approx(-1.0)
    rng = np.random.default_rng(0)
    assert abs(Generation(rng.normal(size=2000), rng.normal(size=2000)).pearson) < 0.1


def test_few_draws_have_no_correlation():
    assert np.isnan(Generation(np.array([1.0, 2.0]), np.array([1.0, 2.0])).pearson)


def test_draws_are_repeatable_and_farther_codes_have_farther_surfaces():
    model = ellipsoid_model()
    seen = []
    found = generated(model, samples=30, seed=4, watch=seen.append)
    again = generated(model, samples=30, seed=4)
    assert seen == list(range(30))
    assert np.array_equal(found.latent, again.latent)
    assert np.array_equal(found.surface_mm, again.surface_mm)
    assert found.pearson > 0.5
