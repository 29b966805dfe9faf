"""Which points of space were drawn on."""

import numpy as np
import pytest

from model.inference.completion.drawn import drawn_at
from model.inference.mask_stack import MaskStack, Plane
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import ORTHOGONAL, cube_around, drawn, rotation

CENTRE = np.array([30.0, -20.0, 50.0])
SHAPE = Ellipsoid((12.0, 9.0, 7.0), CENTRE)
TURNED = cube_around(CENTRE, step=0.7, turn=rotation(35.0, (1.0, 2.0, -1.0)))


def normal_of(grid, plane):
    return grid.directions[:, plane.axis]


@pytest.mark.parametrize("grid", [cube_around(CENTRE), TURNED], ids=["upright", "turned"])
def test_points_on_a_plane_have_its_labels_and_others_none(grid):
    stack, plane = drawn(SHAPE, grid), ORTHOGONAL[1]
    rng = np.random.default_rng(0)
    index = rng.uniform(4.0, 36.0, (4000, 3))
    index[:, plane.axis] = plane.index + rng.uniform(-2.0, 2.0, 4000)
    points = grid.to_world(index)
    found = drawn_at(points, 0.5, [stack], [plane])
    gap = (points - CENTRE) @ normal_of(grid, plane)
    near = np.abs(gap) <= 0.5
    np.testing.assert_array_equal(found.any(axis=0), near)
    on_plane = points - gap[:, None] * normal_of(grid, plane)
    clear = near & (np.abs(SHAPE.logits(on_plane)) > 1.0)
    np.testing.assert_array_equal(found[0][clear], SHAPE.logits(on_plane)[clear] > 0)
    np.testing.assert_array_equal(found[1][clear], SHAPE.logits(on_plane)[clear] < 0)


def test_no_point_is_both_where_planes_cross():
    stack = drawn(SHAPE, TURNED)
    points = CENTRE + np.random.default_rng(1).uniform(-12.0, 12.0, (20_000, 3))
    found = drawn_at(points, 0.6, [stack], ORTHOGONAL)
    assert found[0].any()
    assert found[1].any()
    assert not found.all(axis=0).any()


def test_of_planes_close_together_the_nearest_one_counts_in_any_order():
    """Between two planes of which one shows the shape and the other one does not."""
    stack = drawn(SHAPE, cube_around(CENTRE), [Plane(0, 2, 20)])
    planes = [Plane(0, 2, 20), Plane(0, 2, 21)]
    points = CENTRE + np.array([[0.0, 0.0, height] for height in (0.1, 0.4, 0.6, 0.9)])
    for order in (planes, planes[::-1]):
        found = drawn_at(points, 2.0, [stack], order)
        np.testing.assert_array_equal(found[0], [True, True, False, False])
        np.testing.assert_array_equal(found[1], ~found[0])


def test_many_close_planes_do_not_thicken_what_is_drawn():
    grid = cube_around(CENTRE, step=0.35, nodes=91)
    stack = drawn(SHAPE, grid, [Plane(0, 2, index) for index in range(91)])
    points = CENTRE + np.random.default_rng(2).uniform(-12.0, 12.0, (20_000, 3))
    found = drawn_at(points, 0.6, [stack], [Plane(0, 2, index) for index in range(91)])
    clear = np.abs(SHAPE.logits(points)) > 0.4
    np.testing.assert_array_equal(found[0][clear], SHAPE.logits(points)[clear] > 0)


def test_what_was_never_looked_at_and_what_lies_off_the_image_was_not_drawn():
    grid = cube_around(CENTRE)
    whole = drawn(SHAPE, grid)
    excluded = np.zeros(grid.shape, bool)
    excluded[:20] = True
    stack = MaskStack(whole.part, grid, whole.foreground & ~excluded, excluded)
    points = CENTRE + np.array([[-5.0, 0.0, 0.0], [5.0, 0.0, 0.0], [25.0, 0.0, 0.0]])
    found = drawn_at(points, 0.5, [stack], [Plane(0, 2, 20)])
    np.testing.assert_array_equal(found, [[False, True, False], [False, False, False]])


def test_nothing_is_drawn_without_planes():
    assert not drawn_at(CENTRE[None], 0.5, [drawn(SHAPE, TURNED)], []).any()
