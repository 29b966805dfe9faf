"""Thick slices: what is drawn on one is what fills most of its thickness.

A voxel of a thick slice is foreground when at least half of its column through the slice is: when the median of the
field through the thickness is positive. So each observation is placed where that median lies, found at the current
fit, and the fit goes on from there; one or two rounds settle it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.inference.fitting import Fit, FitOptions, refit
from model.inference.mask_stack import MaskStack, Plane
from model.inference.observations import Observations
from model.inference.posterior import model_logits

#: A slice is thick when its spacing is this many times that of its voxels in the plane.
THICK_RATIO = 2.5
#: Places through the thickness, as shares of it; an odd number, so that one of them is the median.
PLACES = (-0.4, -0.2, 0.0, 0.2, 0.4)
ROUNDS = 2


def through_thickness(
    model: ShapeModel, found: Fit, stacks: Sequence[MaskStack], observations: Observations, options: FitOptions
) -> tuple[Fit, Observations]:
    """The fit to observations placed at the medians of their columns; unchanged where no slice is thick."""
    columns = columns_of(stacks, observations.planes)[observations.plane_of]
    if not columns.any():
        return found, observations
    placed = observations
    for _ in range(ROUNDS):
        placed = at_medians(model, found, observations, columns)
        found = refit(model, placed, found, options)
    return found, placed


def columns_of(stacks: Sequence[MaskStack], planes: Sequence[Plane]) -> Float[np.ndarray, "k 3"]:
    """Vector (world mm) through each slice, zero where it is not thick."""
    return np.array([_through(stacks[plane.stack], plane) for plane in planes]).reshape(-1, 3)


def along(points: Float[np.ndarray, "n 3"], columns: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "k n 3"]:
    """Places through the thickness at each point (world mm)."""
    return np.stack([points + share * columns for share in PLACES])


def at_medians(
    model: ShapeModel, found: Fit, observations: Observations, columns: Float[np.ndarray, "n 3"]
) -> Observations:
    """Observations moved to where the fitted field takes its median through the slice."""
    moved = along(observations.points, columns)
    logits = model_logits(model, found, moved.reshape(-1, 3)).reshape(moved.shape[:2])
    median = np.argsort(logits, axis=0, kind="stable")[len(PLACES) // 2]
    return replace(observations, points=moved[median, np.arange(len(median))])


def thickness_mm(stack: MaskStack, plane: Plane) -> float:
    """Thickness of a slice, 0 when it is of the order of its voxels' size in the plane."""
    spacing = stack.grid.spacing
    thick = spacing[plane.axis] > THICK_RATIO * np.delete(spacing, plane.axis).max()
    return float(spacing[plane.axis] * thick)


def _through(stack: MaskStack, plane: Plane) -> Float[np.ndarray, "3"]:
    return np.asarray(thickness_mm(stack, plane) * stack.grid.directions[:, plane.axis])
