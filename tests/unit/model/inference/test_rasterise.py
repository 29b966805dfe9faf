import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.geometry import Grid
from model.inference.isosurface import extract_surface
from model.inference.mesh import Mesh, empty_mesh
from model.inference.rasterise import rasterise
from tests.analytic_shapes import Box, Ellipsoid, Torus, voxel_centres

SHAPE = Ellipsoid((7.0, 9.0, 14.0), np.array([30.0, -12.0, 5.0]))


@pytest.fixture(scope="module")
def surface() -> Mesh:
    low, high = SHAPE.centre - 16.0, SHAPE.centre + 16.0
    return extract_surface(SHAPE.logits, low, high, 0.5, gradient=SHAPE.logits_and_gradients)


def turned_grid(seed, mirrored):
    rng = np.random.default_rng(seed)
    spacing = rng.uniform(0.7, 2.0, 3) * np.array([-1.0 if mirrored else 1.0, 1.0, 1.0])
    shape = (28, 30, 33)
    affine = np.eye(4)
    affine[:3, :3] = Rotation.random(rng=rng).as_matrix() * spacing
    affine[:3, 3] = SHAPE.centre - affine[:3, :3] @ (np.array(shape) / 2.0) + rng.uniform(-3.0, 3.0, 3)
    return Grid(shape, affine)


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_voxels_of_an_ellipsoid_on_turned_grids(surface, seed, mirrored):
    grid = turned_grid(seed, mirrored)
    clear = np.abs(SHAPE.logits(voxel_centres(grid))).reshape(grid.shape) > 0.05
    found = rasterise(surface, grid)
    np.testing.assert_array_equal(found[clear], SHAPE.mask(grid)[clear])
    assert found.any()


@given(st.integers(0, 2**32 - 1))
def test_hole_of_a_torus_stays_open(seed):
    ring = Torus(9.0, 3.0)
    body = extract_surface(ring.logits, np.full(3, -14.0), np.full(3, 14.0), 0.5)
    grid = turned_grid(seed, mirrored=False)
    affine = grid.affine.copy()
    affine[:3, 3] -= SHAPE.centre
    values = ring.logits(voxel_centres(Grid(grid.shape, affine))).reshape(grid.shape)
    clear = np.abs(values) > 0.05
    np.testing.assert_array_equal(rasterise(body, Grid(grid.shape, affine))[clear], (values > 0)[clear])


@given(st.tuples(*[st.integers(1, 4)] * 3), st.tuples(*[st.integers(1, 4)] * 3))
def test_faces_and_edges_through_voxel_centres_count_once(first, size):
    half = np.array(size) / 2.0
    found = rasterise(Box(tuple(half), np.array(first) + half).surface, Grid((10, 10, 10), np.eye(4)))
    assert found.sum() == np.prod(size)
    inner = tuple(slice(a + 1, a + n) for a, n in zip(first, size, strict=True))
    assert found[inner].all()


def test_translation_by_one_voxel_moves_the_mask(surface):
    grid = Grid(
        (40, 40, 40), np.block([[np.eye(3), (SHAPE.centre - 20.0)[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    )
    moved = Mesh(surface.vertices + np.array([1.0, 2.0, 3.0]), surface.faces, surface.normals)
    np.testing.assert_array_equal(rasterise(moved, grid)[1:, 2:, 3:], rasterise(surface, grid)[:-1, :-2, :-3])


def test_part_of_the_body_outside_the_grid_is_cut_off(surface):
    affine = np.eye(4)
    affine[:3, 3] = SHAPE.centre
    grid = Grid((6, 20, 9), affine)
    clear = np.abs(SHAPE.logits(voxel_centres(grid))).reshape(grid.shape) > 0.05
    np.testing.assert_array_equal(rasterise(surface, grid)[clear], SHAPE.mask(grid)[clear])
    assert rasterise(surface, grid)[0, 0].all()


def test_empty_mesh_fills_no_voxel():
    assert not rasterise(empty_mesh(), Grid((3, 4, 5), np.eye(4))).any()
