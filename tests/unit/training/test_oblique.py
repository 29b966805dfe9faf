from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.errors import CohortError
from model.geometry import Grid
from model.inference.observations import find_planes
from tests.analytic_shapes import Ellipsoid
from training.cohorts import Case
from training.oblique import LEAST_AREA_MM2, least_area, random_planes, section

RADIUS = 12.0
CENTRE = np.array([1.2, -0.7, 0.4])


def ball(spacing=(1.0, 1.0, 1.0), name="ball"):
    shape = tuple(int(40 / step) for step in spacing)
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = -20.0 + np.array(spacing) / 2
    grid = Grid(shape, affine)
    return Case(name, name, "test", Ellipsoid((RADIUS, RADIUS, RADIUS), CENTRE).mask(grid), grid)


directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@given(directions, st.floats(-9.0, 9.0))
def test_sections_of_a_ball_are_discs(direction, height):
    normal = np.array(direction) / np.linalg.norm(direction)
    stack = section(ball(), normal, float(CENTRE @ normal) + height, "mask[0]")
    assert stack.grid.shape[2] == 1
    inside = stack.grid.to_world(np.argwhere(stack.foreground).astype(float))
    middle, radius = CENTRE + height * normal, np.sqrt(RADIUS**2 - height**2)
    np.testing.assert_allclose(inside @ normal, middle @ normal, atol=1e-9)
    # Labels are those of the nearest voxel, which may lie half a voxel's diagonal beside the plane.
    np.testing.assert_allclose(inside.mean(axis=0), middle, atol=0.5 * np.sqrt(3.0))
    assert np.linalg.norm(inside - middle, axis=1).max() < radius + 1.0
    tolerance = np.pi * (abs(height) + 0.06 * radius**2)
    assert stack.foreground.sum() == pytest.approx(np.pi * radius**2, abs=tolerance)


def test_a_section_along_the_voxels_is_the_slice():
    case = ball()
    index = 23
    stack = section(case, np.array([0.0, 0.0, 1.0]), float(case.grid.affine[2, 3] + index), "mask[0]")
    assert stack.foreground.sum() == case.mask[:, :, index].sum()
    found = case.grid.to_index(stack.grid.to_world(np.argwhere(stack.foreground).astype(float)))
    assert case.mask[tuple(np.rint(found).astype(int).T)].all()


def test_what_lies_beyond_the_crop_is_unknown():
    case = ball()
    stack = section(case, np.array([1.0, 1.0, 0.0]) / np.sqrt(2), 0.0, "mask[0]")
    index = case.grid.to_index(stack.grid.centres()).reshape(*stack.grid.shape, 3)
    beyond = ((index < 0) | (index > np.array(case.grid.shape) - 1)).any(axis=-1)
    np.testing.assert_array_equal(stack.excluded, beyond)
    assert not (stack.foreground & stack.excluded).any()


@pytest.mark.parametrize("count", [2, 5, 16])
def test_planes_hold_the_object_and_are_taken_by_inference(count):
    drawing = random_planes(ball((1.0, 1.0, 2.0)), count)
    assert len(drawing.stacks) == len(drawing.planes) == count
    assert all(stack.foreground.sum() >= LEAST_AREA_MM2 for stack in drawing.stacks)
    normals = np.array([stack.grid.directions[:, 2] for stack in drawing.stacks])
    assert np.unique(normals.round(6), axis=0).shape[0] == count
    if count == 2:
        assert find_planes(drawing.stacks, drawing.planes) == drawing.planes


@pytest.mark.parametrize("size", [0.05, 0.1, 0.3])
def test_planes_of_small_structures_hold_a_tenth_of_their_section(size):
    case = ball()
    small = replace(case, grid=Grid(case.grid.shape, np.diag([size] * 3 + [1.0]) @ case.grid.affine))
    largest = case.mask.sum(axis=(0, 1)).max() * size**2
    assert least_area(small) == pytest.approx(min(LEAST_AREA_MM2, 0.1 * largest))
    areas = [stack.foreground.sum() * size**2 for stack in random_planes(small, 4).stacks]
    assert min(areas) >= least_area(small) - 1e-9


def test_what_planes_miss_is_refused_by_name():
    mask = np.zeros((30, 30, 30), bool)
    mask[[2, 27], [2, 27], [2, 27]] = True
    grains = Case("grains", "grains", "test", mask, Grid(mask.shape, np.eye(4)))
    with pytest.raises(CohortError, match="grains: hardly any plane"):
        random_planes(grains, 2, tries=3)


def test_more_planes_hold_the_fewer_and_another_name_has_other_ones():
    few, many = random_planes(ball(), 3), random_planes(ball(), 8)
    for one, other in zip(few.stacks, many.stacks[:3], strict=True):
        np.testing.assert_array_equal(one.grid.affine, other.grid.affine)
        np.testing.assert_array_equal(one.foreground, other.foreground)
    other = random_planes(ball(name="another"), 3)
    assert not np.allclose(few.stacks[0].grid.affine, other.stacks[0].grid.affine)
