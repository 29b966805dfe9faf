import numpy as np
import pytest

from model.bundle import open_bundle
from model.errors import InvalidParameter
from model.geometry import Pose
from model.inference.decimation import _folds, _mended, _sharpest, _unfolded, decimated, hausdorff_mm
from model.inference.isosurface import extract_surface
from model.inference.mesh import Mesh, empty_mesh, is_watertight, transformed
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
        model = open_bundle(folder, threads=1)
        for code in model.population.codes[:3]:
            mesh = surface_of(model, code, Pose())
            fewer = decimated(mesh, 0.2)
            assert is_watertight(fewer)
            assert intersecting_pairs(fewer) == 0
            assert hausdorff_mm(mesh, fewer) <= 0.2
            # Bent everywhere, a vertebra can spare fewer.
            assert len(fewer.faces) <= (0.8 if folder.name == "vertebra" else 0.6) * len(mesh.faces)


def face_set(mesh):
    """Faces as rows of places that begin with the smallest, whatever the order of vertices."""
    places = mesh.vertices[mesh.faces].round(9).tolist()
    return sorted(min([row[k:] + row[:k] for k in range(3)]) for row in places)


def with_spike(mesh, face, beyond):
    """The mesh with a vertex put into a face, so far beyond one of its edges that the new faces fold."""
    a, b, c = mesh.faces[face]
    place = mesh.vertices[[a, b]].mean(axis=0) + beyond * (mesh.vertices[[a, b]].mean(axis=0) - mesh.vertices[c])
    new = len(mesh.vertices)
    faces = np.concatenate([np.delete(mesh.faces, face, axis=0), [(new, a, b), (new, b, c), (new, c, a)]])
    vertices = np.concatenate([mesh.vertices, place[None]])
    return Mesh(vertices, faces, np.concatenate([mesh.normals, mesh.normals[a : a + 1]]))


@pytest.mark.parametrize("face", [0, 100, 333])
def test_a_vertex_that_folds_its_three_faces_is_taken_out(face):
    folded = with_spike(BALL, face, beyond=0.2)
    assert is_watertight(folded)
    assert _sharpest(folded) < -0.5
    assert face_set(_unfolded(folded, -0.5)) == face_set(BALL)


def test_swapping_an_edge_twice_brings_it_back():
    _, edges, owners = _folds(BALL)
    swapped = 0
    for edge, both in zip(edges[:40], owners[:40], strict=True):
        once = _mended(BALL, edge, both)
        if once is None or len(once.vertices) < len(BALL.vertices):
            continue
        assert is_watertight(once)
        ends = np.sort([np.setdiff1d(BALL.faces[row], edge)[0] for row in both])
        _, other, other_owners = _folds(once)
        row = int(np.flatnonzero((other == ends).all(axis=1))[0])
        assert face_set(_mended(once, other[row], other_owners[row])) == face_set(BALL)
        swapped += 1
    assert swapped > 10


def test_a_mesh_without_folds_is_left_alone():
    assert _unfolded(BALL, -0.5) is BALL


def test_nothing_stays_nothing():
    assert decimated(empty_mesh(), 1.0).is_empty


@pytest.mark.parametrize("error", [-0.1, float("nan"), float("inf")])
def test_impossible_bounds_are_refused(error):
    with pytest.raises(InvalidParameter) as refusal:
        decimated(BALL, error)
    assert refusal.value.part == "max_error_mm"
