import nibabel as nib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.errors import InconsistentStacks, InvalidMask
from model.geometry import Grid
from model.inference.observations import MaskStack, Plane
from tests.analytic_shapes import Ellipsoid
from training.baselines.contours import itk_contour_interpolation
from training.baselines.interpolation import signed_distance_interpolation
from training.metrics_masks import agreement, dice

SPACING = np.array([1.0, 0.8, 0.9])


def grid_of(shape, origin=(0.0, 0.0, 0.0)):
    affine = np.diag([*SPACING, 1.0])
    affine[:3, 3] = origin
    return Grid(shape, affine)


def drawn(mask, grid, axis, indices):
    kept = np.zeros(mask.shape, bool)
    np.moveaxis(kept, axis, 0)[list(indices)] = True
    return MaskStack("mask[0]", grid, mask & kept, ~kept), tuple(Plane(0, axis, index) for index in indices)


def body(axis=2):
    semi_axes = [11.0, 9.0, 9.5]
    semi_axes[axis] = 16.0
    grid = grid_of((44, 50, 48))
    return Ellipsoid(tuple(semi_axes), np.array([20.0, 19.0, 21.0])).mask(grid), grid


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_drawn_slices_come_back_and_the_rest_comes_close(axis):
    mask, grid = body(axis)
    stack, planes = drawn(mask, grid, axis, range(5, 44, 4))
    occupied = tuple(plane for plane in planes if np.take(mask, plane.index, axis).any())
    found = signed_distance_interpolation(stack, occupied, grid)
    for plane in occupied:
        np.testing.assert_array_equal(np.take(found, plane.index, axis), np.take(mask, plane.index, axis))
    assert dice(mask, found) > 0.95


@given(st.integers(1, 5), st.integers(7, 12))
def test_equal_sections_give_a_cylinder_between_them(first, last):
    mask, _ = body()
    section = np.repeat(mask[:, :, 24:25], 16, axis=2)
    flat = grid_of(section.shape)
    found = signed_distance_interpolation(*drawn(section, flat, 2, (first, last)), flat)
    np.testing.assert_array_equal(found[:, :, first : last + 1], section[:, :, first : last + 1])


def test_ends_recede_and_close():
    mask, grid = body()
    stack, planes = drawn(mask, grid, 2, (20, 28))
    areas = signed_distance_interpolation(stack, planes, grid).sum(axis=(0, 1))
    assert (np.diff(areas[28:]) <= 0).all()
    assert (np.diff(areas[:21]) >= 0).all()
    assert 0 < areas[30] < areas[28]
    assert areas[-1] == 0


def test_empty_drawn_slice_stays_empty():
    mask, grid = body()
    stack, planes = drawn(mask, grid, 2, (0, 24, 47))
    found = signed_distance_interpolation(stack, planes, grid)
    assert not found[:, :, [0, 47]].any()
    np.testing.assert_array_equal(found[:, :, 24], mask[:, :, 24])


def test_thick_slices_stand_at_their_centres():
    mask, grid = body()
    coarse = mask.reshape(44, 50, 12, 4).mean(axis=3) >= 0.5
    affine = grid.affine @ np.diag([1.0, 1.0, 4.0, 1.0])
    affine[:3, 3] += grid.affine[:3, 2] * 1.5
    stack = MaskStack("mask[0]", Grid(coarse.shape, affine), coarse, np.zeros_like(coarse))
    planes = tuple(Plane(0, 2, int(index)) for index in np.flatnonzero(coarse.any(axis=(0, 1))))
    found = signed_distance_interpolation(stack, planes, grid)
    centre = [np.argwhere(each)[:, 2].mean() for each in (mask, found)]
    assert centre[0] == pytest.approx(centre[1], abs=0.1)
    assert dice(mask, found) > 0.95


def cross(mask, indices):
    kept = np.zeros(mask.shape, bool)
    for axis, index in indices:
        np.moveaxis(kept, axis, 0)[index] = True
    return mask & kept


@pytest.mark.parametrize(
    "indices",
    [
        [(2, index) for index in (12, 18, 24, 30, 36)],
        [(axis, index) for axis in range(3) for index in (16, 22, 28)],
    ],
)
def test_itk_keeps_what_was_drawn_and_fills_between(indices):
    mask, _ = body()
    drawing = cross(mask, indices)
    found = itk_contour_interpolation(drawing)
    assert found[drawing].all()
    assert dice(mask, found) > 0.7 > dice(mask, drawing)


def test_itk_has_nothing_to_fill_between_single_slices():
    mask, _ = body()
    drawing = cross(mask, [(0, 20), (1, 25), (2, 24)])
    np.testing.assert_array_equal(itk_contour_interpolation(drawing), drawing)


def test_itk_answers_alike_every_time():
    mask, grid = body()
    stack, _ = drawn(mask, grid, 2, range(10, 40, 5))
    first = itk_contour_interpolation(stack.foreground)
    for _ in range(5):
        np.testing.assert_array_equal(itk_contour_interpolation(stack.foreground), first)


def test_no_plane_is_refused():
    mask, grid = body()
    with pytest.raises(InvalidMask):
        signed_distance_interpolation(drawn(mask, grid, 2, (24,))[0], (), grid)


def test_planes_along_two_axes_are_refused():
    mask, grid = body()
    stack, planes = drawn(mask, grid, 2, (24,))
    with pytest.raises(InconsistentStacks):
        signed_distance_interpolation(stack, (*planes, Plane(0, 0, 20)), grid)


@pytest.mark.parametrize("other", [grid_of((44, 50, 48), (0.5, 0.0, 0.0)), grid_of((40, 50, 48))])
def test_target_with_other_in_plane_voxels_is_refused(other):
    mask, grid = body()
    stack, planes = drawn(mask, grid, 2, (24,))
    with pytest.raises(InconsistentStacks):
        signed_distance_interpolation(stack, planes, other)


def test_hippocampi_get_the_known_accuracy(shared_data):
    figures = []
    for path in sorted((shared_data / "hippocampus" / "test").glob("*.nii.gz")):
        image = nib.load(path)
        mask = np.asarray(image.dataobj) > 0
        occupied = np.flatnonzero(mask.any(axis=(0, 1)))
        centred = range(occupied[0] + (occupied[-1] - occupied[0]) % 8 // 2, occupied[-1] + 1, 8)
        grid = Grid(mask.shape, image.affine)
        found = signed_distance_interpolation(*drawn(mask, grid, 2, centred), grid)
        figures.append(agreement(mask, found, grid.spacing))
    assert np.mean([each.dice for each in figures]) == pytest.approx(0.63, abs=0.03)
    assert np.mean([each.asd_mm for each in figures]) == pytest.approx(0.89, abs=0.06)
