"""Surfaces of masks against the analytic shapes that they digitise."""

import numpy as np
import pytest

from tests.drawn_shapes import cube_around
from training.surface_error import anti_aliased_points, digitisation_mm, distances_to, true_points

CENTRE = np.array([30.0, -20.0, 50.0])
RADIUS = 11.0


def ball(step=1.0):
    grid = cube_around(CENTRE, step=step)
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), axis=-1).astype(float)
    return np.linalg.norm(grid.to_world(index.reshape(-1, 3)) - CENTRE, axis=1).reshape(grid.shape) <= RADIUS, grid


def off(points):
    return np.linalg.norm(points - CENTRE, axis=1) - RADIUS


def test_points_lie_on_the_surface_to_within_its_stairs():
    mask, grid = ball()
    distance = off(true_points(mask, grid))
    assert np.abs(distance).max() < 0.9
    assert np.sqrt(np.mean(distance**2)) == pytest.approx(digitisation_mm(grid), rel=0.5)


def test_without_its_stairs_a_surface_is_nearer_to_the_shape():
    mask, grid = ball()
    smooth, stairs = off(anti_aliased_points(mask, grid)), off(true_points(mask, grid))
    assert smooth.std() < 0.6 * stairs.std()
    assert abs(smooth.mean()) < 0.15


def test_it_keeps_the_voxels_on_their_sides():
    """Within half a voxel of the mask's own surface, thin parts and all."""
    mask, grid = ball()
    mask = mask.copy()
    mask[5:-5, mask.shape[1] // 2, mask.shape[2] // 2] = True
    assert distances_to(true_points(mask, grid), anti_aliased_points(mask, grid)).max() < 1.0


def test_distances_are_those_to_the_nearest_point():
    points = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    assert distances_to(points, np.array([[1.0, 0.0, 0.0], [6.0, 3.0, 0.0]])).tolist() == [1.0, 5.0]
