import numpy as np
import pytest

from model.bundle import open_bundle
from model.errors import InvalidParameter
from model.geometry import Pose
from model.inference.decimation import decimated, hausdorff_mm
from model.inference.isosurface import extract_surface
from model.inference.mesh import empty_mesh, is_watertight, transformed
from model.inference.surface import surface_of
from tests.analytic_shapes import Box, Torus, sphere
from tests.triangle_pairs import intersecting_pairs

LOW, HIGH = np.full(3, -14.0), np.full(3, 14.0)
BALL = extract_surface(sphere(8.0).logits, LOW, HIGH, 1.0, gradient=sphere(8.0).logits_and_gradients)


def test_distance_of_shifted_and_of_scaled_balls():
    shift, scale = np.eye(4), np.diag([1.1, 1.1, 1.1, 1.0])
    shift[0, 3] = 0.7
    assert hausdorff_mm(BALL, BALL) < 1e-6
    assert hausdorff_mm(BALL, transformed(BALL, shift)) == pytest.approx(0.7, abs=0.02)
    assert hausdorff_mm(BALL, transformed(BALL, scale)) == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize("error", [0.02, 0.1, 0.4])
@pytest.mark.parametrize(
    "field", [sphere(8.0).logits, Torus(8.0, 3.0).logits, Box((7.0, 5.0, 1.2), np.full(3, 0.2)).logits]
)
def test_the_bound_is_kept_and_the_surface_stays_closed(field, error):
    mesh = extract_surface(field, LOW, HIGH, 1.0)
    fewer = decimated(mesh, error)
    assert len(fewer.faces) <= len(mesh.faces)
    assert is_watertight(fewer)
    assert intersecting_pairs(fewer) == 0
    assert hausdorff_mm(mesh, fewer) <= error


def test_more_error_leaves_fewer_faces():
    counts = [len(decimated(BALL, error).faces) for error in (0.0, 0.03, 0.1, 0.5)]
    assert counts[0] == len(BALL.faces)
    assert sorted(counts, reverse=True) == counts
    assert counts[-1] < counts[0] / 4


def test_vertices_of_a_decimated_ball_are_near_the_ball():
    fewer = decimated(BALL, 0.1)
    assert np.abs(np.linalg.norm(fewer.vertices, axis=1) - 8.0).max() < 0.15


def test_scalars_come_along():
    mesh = BALL.with_scalars(height_mm=BALL.vertices[:, 2].copy())
    fewer = decimated(mesh, 0.2)
    assert len(fewer.vertices) < len(mesh.vertices)
    assert np.abs(fewer.scalars["height_mm"] - fewer.vertices[:, 2]).max() < 1.5


def test_samples_of_shipped_models(shipped_bundles):
    for folder in shipped_bundles:
        model, shares = open_bundle(folder, threads=1), []
        for code in model.population.codes[:3]:
            mesh = surface_of(model, code, Pose())
            fewer = decimated(mesh, 0.2)
            assert is_watertight(fewer)
            assert intersecting_pairs(fewer) == 0
            assert hausdorff_mm(mesh, fewer) <= 0.2
            shares.append(len(fewer.faces) / len(mesh.faces))
        assert np.median(shares) < 0.6  # a single sharp edge may bind one of them


def test_nothing_stays_nothing():
    assert decimated(empty_mesh(), 1.0).is_empty


@pytest.mark.parametrize("error", [-0.1, float("nan"), float("inf")])
def test_impossible_bounds_are_refused(error):
    with pytest.raises(InvalidParameter) as refusal:
        decimated(BALL, error)
    assert refusal.value.part == "max_error_mm"
