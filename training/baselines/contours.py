"""Morphological interpolation of contours, by ITK."""

from typing import Any

import itk
import numpy as np
from jaxtyping import Bool


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
