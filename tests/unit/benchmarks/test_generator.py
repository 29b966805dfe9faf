"""The generator's figures: distances of known surfaces, densities of known Gaussians, verdicts."""

import numpy as np
import pytest
import trimesh
from scipy.stats import multivariate_normal

from benchmarks.contact_sheet import save_draws, save_modes
from benchmarks.generator.density import GaussianPrior
from benchmarks.generator.measuring import Plan, draw_all
from benchmarks.generator.principal import principal_modes, projected
from benchmarks.generator.surfaces import distance_mm, nearest_mm, surface_from, surface_of_mask
from benchmarks.generator.table import Figure, markdown
from model.geometry import Grid
from model.inference.mesh import mesh_of
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from training.cohorts.cohort import Case


def ball(radius, centre=(0.0, 0.0, 0.0)):
    body = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return surface_from(mesh_of(np.asarray(body.vertices) + centre, np.asarray(body.faces)))


def case_of(axes, number=0):
    grid = Grid((40, 36, 32), np.eye(4))
    return Case(f"e{number}", f"e{number}", "train", Ellipsoid(axes, np.array([20.0, 18.0, 16.0])).mask(grid), grid)


def test_balls_are_apart_by_their_radii_wherever_they_lie():
    small, large = ball(8.0), ball(9.5, (3.0, -2.0, 40.0))
    assert distance_mm(small, large) == pytest.approx(1.5, abs=0.05)
    assert distance_mm(large, small) == distance_mm(small, large)
    assert distance_mm(small, small) == 0.0


def test_the_nearest_of_a_population_is_found_and_can_be_left_out():
    population = [ball(radius) for radius in (6.0, 7.0, 8.0, 12.0, 13.0, 14.0, 15.0, 16.0, 17.0, 18.0, 19.0)]
    assert nearest_mm(ball(7.2), population) == pytest.approx(0.2, abs=0.05)
    assert nearest_mm(population[2], population, leave_out=[2]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_masks_surface_has_its_measures(mirrored):
    shape = surface_of_mask(case_of((14.0, 10.0, 8.0)), mirrored=mirrored)
    assert shape.volume_ml == pytest.approx(4 / 3 * np.pi * 14 * 10 * 8 / 1000, rel=0.03)
    assert shape.parts == 1
    outward = np.sum(shape.points * shape.normals, axis=1)
    assert (outward > 0).mean() > 0.99


def test_a_shrunk_gaussian_is_between_the_sample_and_the_identity():
    codes = np.random.default_rng(0).normal(size=(30, 4)) * [3.0, 1.0, 1.0, 0.2]
    prior = GaussianPrior.of(codes)
    sample = np.cov(codes.T, bias=True)
    assert np.trace(prior.covariance) == pytest.approx(np.trace(sample))
    assert np.linalg.cond(prior.covariance) < np.linalg.cond(sample)
    expected = multivariate_normal.logpdf(codes, prior.mean, prior.covariance)
    np.testing.assert_allclose(prior.log_density(codes), expected)
    np.testing.assert_array_equal(prior.draw(5, 1), prior.draw(5, 1))


def test_the_shrinkage_vanishes_for_many_codes():
    codes = np.random.default_rng(1).normal(size=(20000, 3)) * [3.0, 1.0, 0.2]
    np.testing.assert_allclose(GaussianPrior.of(codes).covariance, np.cov(codes.T, bias=True), atol=0.02)


def test_principal_modes_describe_what_they_were_learnt_from():
    cases = [case_of((12.0 + n, 10.0 - 0.3 * n, 7.0 + 0.2 * n), n) for n in range(5)]
    modes = principal_modes(cases, 4)
    truth = surface_of_mask(cases[3])
    assert distance_mm(projected(modes, cases[3]), truth) < 0.4
    assert distance_mm(projected(modes, cases[0]), truth) > 0.6


def test_draws_are_those_of_the_service_without_rejection():
    model = ellipsoid_model()
    draws = draw_all(model, Plan(4, 2, 2, 1, 2.0))
    axes = model.decoder.axes(np.stack([np.random.default_rng(seed).standard_normal(3) for seed in range(4)]))
    volumes = 4 / 3 * np.pi * axes.prod(axis=1) / 1000
    np.testing.assert_allclose([s.volume_ml for s in draws], volumes, rtol=0.03)


@pytest.mark.parametrize(
    ("figure", "verdict"),
    [
        (Figure("a", 1.0, limit=1.0), True),
        (Figure("a", 1.1, limit=1.0), False),
        (Figure("a", 1.1, limit=1.0, at_most=False), True),
        (Figure("a", float("nan"), limit=1.0), False),
        (Figure("a", 3.0), None),
    ],
)
def test_verdicts(figure, verdict):
    assert figure.reached is verdict
    assert ("reached" in markdown("t", [figure])) is (verdict is not None)
    assert ("not reached" in markdown("t", [figure])) is (verdict is False)


def test_contact_sheets_are_written(tmp_path):
    model = ellipsoid_model()
    save_draws(model, 4, 3.0, tmp_path / "draws.png", reject=True)
    save_modes(model, 2, 3.0, tmp_path / "modes.png")
    for name in ("draws.png", "modes.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
