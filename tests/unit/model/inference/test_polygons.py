"""Marching cubes in blocks against scikit-image on the whole grid, and triangles that do not pierce each other."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from skimage import measure

from model.bundle import open_bundle
from model.geometry import Pose
from model.inference.isosurface import edge_zeros, extract_surface
from model.inference.mesh import Mesh, is_watertight, mesh_of
from model.inference.surface import surface_of
from tests.analytic_shapes import Box, Ellipsoid, Torus, sphere
from tests.dense_fields import surface_of_nodes
from tests.triangle_pairs import intersecting_pairs

LOW, HIGH = np.full(3, -20.0), np.full(3, 20.0)


def noise(seed, blur, shape=(9, 8, 7)):
    values = gaussian_filter(np.random.default_rng(seed).normal(size=shape), blur)
    return (values / values.std()).astype(np.float32)


@pytest.mark.parametrize("seed", range(5))
def test_blocks_join_to_what_the_whole_grid_gives(seed):
    values = np.pad(noise(seed, 2.5, (75, 40, 70)), 1, constant_values=-1.0)
    values = np.where(np.abs(values) < 0.01, np.float32(0.01) * np.where(values > 0, 1, -1), values).astype(np.float32)
    mesh = surface_of_nodes(values, np.zeros(3), 1.0)
    vertices, faces, _, _ = measure.marching_cubes(values, 0.0, method="lewiner", gradient_direction="ascent")
    assert is_watertight(mesh)
    assert mesh.vertices.shape == vertices.shape
    assert mesh.faces.shape == faces.shape
    found, expected = mesh.vertices[mesh.faces].mean(axis=1), vertices[faces].mean(axis=1)
    distance, match = cKDTree(found).query(expected)
    assert distance.max() < 0.01
    assert len(np.unique(match)) == len(match)


def test_pairs_are_found_where_there_are_some():
    ball = extract_surface(sphere(5.0).logits, LOW, HIGH, 1.0)
    assert intersecting_pairs(ball) == 0
    moved = np.concatenate([ball.vertices, ball.vertices + np.array([6.1, 0.2, 0.3])])
    assert intersecting_pairs(mesh_of(moved, np.concatenate([ball.faces, ball.faces + len(ball.vertices)]))) > 20
    inverted = ball.vertices.copy()
    inverted[100] *= 0.5
    inverted[7] = inverted[100] * 1.9
    assert intersecting_pairs(Mesh(inverted, ball.faces, ball.normals)) > 0
    flap = np.array([[0.0, 0, 0], [1, 0, 0], [0.3, 1, 0], [0.6, 0.8, 0]])
    assert intersecting_pairs(mesh_of(flap, np.array([[0, 1, 2], [1, 0, 3]]))) == 1


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.7, 1.0, 1.6]))
def test_noise_does_not_pierce_itself(seed, blur):
    assert intersecting_pairs(surface_of_nodes(noise(seed, blur), np.zeros(3), 1.0)) == 0


def slopes_of(field, points, step=1e-4):
    ahead = [field(points + step * axis) - field(points - step * axis) for axis in np.eye(3)]
    return field(points), np.stack(ahead, axis=1) / (2.0 * step)


@st.composite
def shapes(draw):
    turn = Rotation.random(rng=np.random.default_rng(draw(st.integers(0, 2**32 - 1)))).as_matrix()
    size = draw(st.floats(0.3, 4.0))
    gap = draw(st.floats(0.01, 1.5))
    field = draw(
        st.sampled_from(
            [
                Ellipsoid((size, 3.0, 10.0)).logits,
                Torus(7.0, size).logits,
                Box((8.0, 6.0, size / 4.0)).logits,
                lambda p: np.maximum(sphere(6.0).logits(p), sphere(size, (6.0 + size + gap, 0.0, 0.0)).logits(p)),
                lambda p: (
                    3.0 * np.tanh(np.sin(p[:, 0]) + np.cos(p[:, 1] * 1.3) + np.sin(p[:, 2] * 0.8) - 0.1 * size)
                    - 0.02 * np.sum(p * p, axis=1)
                ),
            ]
        )
    )
    return lambda points: field((points - 0.3) @ turn)


@settings(max_examples=60)
@given(shapes(), st.sampled_from([0.7, 1.0, 2.0]))
def test_vertices_moved_onto_the_surface_do_not_pierce_it(field, step):
    mesh = extract_surface(field, LOW, HIGH, step, gradient=lambda p: slopes_of(field, p), keep_specks=True)
    if not mesh.is_empty:
        assert is_watertight(mesh)
        assert intersecting_pairs(mesh) == 0


def test_faces_in_one_plane_that_only_touch_are_no_pair():
    """Slivers at the edge of a plate, where a determinant was 1.2e-14 and not zero."""
    turn = np.array(
        [
            [-0.2793053119426367, -0.5821458232630243, -0.7636064321219681],
            [0.7769262357405557, -0.6043325840526335, 0.17654390975130496],
            [-0.5642465480077273, -0.543956219111136, 0.6210776640257489],
        ]
    )
    plate = Box((8.0, 6.0, 0.5625)).logits

    def field(points):
        return plate((points - 0.3) @ turn)

    mesh = extract_surface(field, LOW, HIGH, 0.7, gradient=lambda p: slopes_of(field, p), keep_specks=True)
    assert is_watertight(mesh)
    assert intersecting_pairs(mesh) == 0


def test_samples_of_shipped_models_do_not_pierce_themselves(shipped_bundles):
    for folder in shipped_bundles:
        model = open_bundle(folder, threads=1)
        random = np.random.default_rng(3)
        base = random.normal(size=(12, model.manifest.latent_size)) * np.asarray(model.manifest.sigmas)
        for code in model.prior.from_base(base):
            mesh = surface_of(model, code, Pose())
            assert is_watertight(mesh)
            assert intersecting_pairs(mesh) == 0


@given(st.floats(0.01, 0.99), st.floats(0.05, 20.0), st.floats(-5.0, 5.0))
def test_zeros_of_cubics_are_found(root, slope, bend):
    def cubic(t):
        return (t - root) * (slope + abs(bend) * (t - root) ** 2)

    at = np.array([0.02, 0.3, 0.6, 0.98])
    tilt = slope + 3.0 * abs(bend) * (at - root) ** 2
    ends = np.tile([cubic(0.0), cubic(1.0)], (4, 1))
    np.testing.assert_allclose(edge_zeros(at, cubic(at), tilt, ends)[1:3], root, atol=1e-4)


@given(st.integers(0, 2**32 - 1))
def test_zeros_stay_on_their_edge_whatever_the_slopes(seed):
    random = np.random.default_rng(seed)
    ends = np.abs(random.normal(size=(50, 2))) * [-1.0, 1.0]
    zeros = edge_zeros(random.random(50), random.normal(size=50), random.normal(size=50) * 1e3, ends)
    assert (zeros > 0).all()
    assert (zeros < 1).all()
