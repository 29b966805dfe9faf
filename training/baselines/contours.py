"""Morphological interpolation of contours, by ITK."""

from typing import Any

import itk
import numpy as np
from jaxtyping import Bool

from model.geometry import Grid
from training.sparsify import Drawing


def itk_contour_interpolation(drawn: Bool[np.ndarray, "i j k"]) -> Bool[np.ndarray, "i j k"]:
    """Morphological contour interpolation (Zukic et al., Insight Journal, 2016) by ITK.

    Takes parallel slices as well as slices along several axes in one mask; ITK finds the axes itself.
    It fills between slices of one axis only: from a single slice along each axis it returns the drawing.

    Args:
        drawn: foreground of the drawn planes, background everywhere else.
    """
    toolkit: Any = itk
    image = toolkit.image_from_array(np.ascontiguousarray(drawn.transpose(2, 1, 0), np.uint8))
    interpolator = toolkit.MorphologicalContourInterpolator[type(image)].New(Input=image)
    # With more than one thread the filter (2.1.2) corrupts the heap and the process often aborts.
    interpolator.SetNumberOfWorkUnits(1)
    interpolator.GetMultiThreader().SetMaximumNumberOfThreads(1)
    interpolator.Update()
    return np.asarray(toolkit.array_from_image(interpolator.GetOutput()).transpose(2, 1, 0) > 0)


def contour_fill(drawing: Drawing, grid: Grid) -> Bool[np.ndarray, "i j k"]:
    """ITK's interpolation on a grid with the same voxels within the slices.

    Thick slices stand half-way between two slices of the grid, so that they are filled at half its step and every
    second slice is the answer. Slices beyond the grid are left out.
    """
    if drawing.stack.grid.coincides_with(grid) or not drawing.planes:
        return itk_contour_interpolation(drawing.stack.foreground)
    axis = drawing.planes[0].axis
    shape = list(grid.shape)
    shape[axis] *= 2
    drawn = np.zeros(shape, bool)
    for plane in drawing.planes:
        corner = np.zeros((1, 3))
        corner[0, axis] = plane.index
        place = round(2 * float(grid.to_index(drawing.stack.grid.to_world(corner))[0, axis]))
        if 0 <= place < shape[axis]:
            section = np.moveaxis(drawing.stack.foreground, axis, 0)[plane.index]
            np.moveaxis(drawn, axis, 0)[place] = section
    filled = np.moveaxis(itk_contour_interpolation(drawn), axis, 0)[::2]
    return np.moveaxis(filled, 0, axis)
