"""Contour points of discs and of sections that are cut off."""

import numpy as np
import pytest

from model.geometry import Grid
from model.inference.discrepancy.contours import MOST_POINTS, contour_points
from model.inference.observations import MaskStack, Plane


def disc(spacing, excluded=None):
    grid = Grid((41, 41, 3), np.diag([spacing, spacing, 2.0, 1.0]))
    centre = 20 * spacing
    inside = np.hypot(*(grid.centres().reshape(41, 41, 3, 3)[..., :2] - centre).transpose(3, 0, 1, 2)) < 12.0
    hidden = np.zeros(inside.shape, bool) if excluded is None else excluded
    return MaskStack("mask[0]", grid, inside, hidden), centre


def test_points_lie_on_the_contour_of_the_plane():
    stack, centre = disc(0.8)
    points, numbers = contour_points([stack], [Plane(0, 2, 0), Plane(0, 2, 2)])
    assert (points[:, 2] == 4.0 * numbers).all()
    radius = np.hypot(points[:, 0] - centre, points[:, 1] - centre)
    assert abs(radius.mean() - 12.0) < 0.1
    assert np.abs(radius - 12.0).max() < 0.8
    angles = np.degrees(np.arctan2(points[:, 1] - centre, points[:, 0] - centre)) % 360
    assert len(np.unique(angles // 10)) == 36


def test_speckled_masks_do_not_give_a_point_for_every_pair():
    random = np.random.default_rng(0)
    grid = Grid((400, 400, 8), np.diag([0.2, 0.2, 2.0, 1.0]))
    stack = MaskStack("mask[0]", grid, random.random(grid.shape) < 0.5, np.zeros(grid.shape, bool))
    points, numbers = contour_points([stack], [Plane(0, 2, index) for index in range(8)])
    assert MOST_POINTS // 2 < len(points) <= MOST_POINTS
    assert (np.bincount(numbers) > MOST_POINTS // 20).all()
    assert np.ptp(points, axis=0) == pytest.approx([79.8, 79.8, 14.0], abs=0.5)


def test_nothing_is_said_beside_voxels_that_were_not_looked_at():
    hidden = np.zeros((41, 41, 3), bool)
    hidden[:21] = True
    stack, _ = disc(1.0, hidden)
    points, _ = contour_points([stack], [Plane(0, 2, 1)])
    assert points[:, 0].min() >= 21.0


def test_a_section_that_is_foreground_throughout_has_no_contour():
    grid = Grid((5, 5, 5), np.eye(4))
    stack = MaskStack("mask[0]", grid, np.ones((5, 5, 5), bool), np.zeros((5, 5, 5), bool))
    points, numbers = contour_points([stack], [Plane(0, 0, 2)])
    assert points.shape == (0, 3)
    assert not numbers.size
