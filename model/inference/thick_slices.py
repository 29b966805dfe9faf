"""Thick slices: what is drawn on one is what fills at least half of its thickness.

A thick slice is the average of slices as thick as its voxels are wide, and a voxel of it is foreground when at least
half of these are: when the field is positive at the one of them that has the least value of the larger half. That is
the median of an odd number, and the upper one of an even number's two medians; of eight slices it lets in a column of
which seven sixteenths are filled, which makes drawings larger than their shape by half of a fine slice at either end.
So each observation is placed where that value is, found at the current fit, and the fit goes on from there; one or two
rounds settle it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from model.bundle import ShapeModel
from model.inference.fitting import Fit, FitOptions, refit
from model.inference.mask_stack import MaskStack, Plane
from model.inference.observations import Observations
from model.inference.posterior import model_logits

#: A slice is thick when its spacing is this many times that of its voxels in the plane.
THICK_RATIO = 2.5
#: Slices that one is taken for the average of at most. An odd number: of more the larger half begins at the median.
MOST_SLICES = 15
ROUNDS = 2

#: Values of a field at points (world mm).
Field = Callable[[Float[np.ndarray, "m 3"]], Float[np.ndarray, "m"]]


@dataclass(frozen=True)
class Columns:
    """What is averaged at points of slices.

    Attributes:
        vectors: through the slice (world mm), zero where it is not thick.
        widths_mm: of a voxel in the slice's plane.
    """

    vectors: Float[np.ndarray, "n 3"]
    widths_mm: Float[np.ndarray, "n"]

    def __getitem__(self, chosen: Int[np.ndarray, "m"] | Bool[np.ndarray, "n"]) -> "Columns":
        return Columns(self.vectors[chosen], self.widths_mm[chosen])

    @property
    def counts(self) -> Int[np.ndarray, "n"]:
        """How many slices are averaged; 0 where the slice is not thick."""
        counts = np.rint(np.linalg.norm(self.vectors, axis=1) / self.widths_mm).astype(int)
        return np.asarray(np.minimum(counts, MOST_SLICES))


def through_thickness(
    model: ShapeModel, found: Fit, stacks: Sequence[MaskStack], observations: Observations, options: FitOptions
) -> tuple[Fit, Observations]:
    """The fit to observations placed where their columns are decided; unchanged where no slice is thick."""
    columns = columns_of(stacks, observations.planes)[observations.plane_of]
    if not columns.counts.any():
        return found, observations
    placed = observations
    for _ in range(ROUNDS):
        places, _ = decided(partial(model_logits, model, found), observations.points, columns)
        placed = replace(observations, points=places)
        found = refit(model, placed, found, options)
    return found, placed


def columns_of(stacks: Sequence[MaskStack], planes: Sequence[Plane]) -> Columns:
    """What is averaged on each plane."""
    drawn = [(stacks[plane.stack], plane) for plane in planes]
    vectors = [thickness_mm(stack, plane) * stack.grid.directions[:, plane.axis] for stack, plane in drawn]
    widths = [np.delete(stack.grid.spacing, plane.axis).max() for stack, plane in drawn]
    return Columns(np.array(vectors).reshape(-1, 3), np.array(widths, float))


def decided(
    field: Field, points: Float[np.ndarray, "n 3"], columns: Columns
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Where in the column at each point a field has the value by whose sign the voxel is drawn, and that value.

    Args:
        points: at the centres of slices (world mm).
    """
    places, values = points.copy(), np.empty(len(points))
    counts = columns.counts
    for count in np.unique(counts):
        rows = counts == count
        shares = (np.arange(count) + 0.5) / count - 0.5 if count else np.zeros(1)
        through = points[rows] + shares[:, None, None] * columns.vectors[rows]
        found = field(through.reshape(-1, 3)).reshape(through.shape[:2])
        chosen = np.argsort(found, axis=0, kind="stable")[len(shares) // 2], np.arange(rows.sum())
        places[rows], values[rows] = through[chosen], found[chosen]
    return places, values


def thickness_mm(stack: MaskStack, plane: Plane) -> float:
    """Thickness of a slice, 0 when it is of the order of its voxels' size in the plane."""
    spacing = stack.grid.spacing
    thick = spacing[plane.axis] > THICK_RATIO * np.delete(spacing, plane.axis).max()
    return float(spacing[plane.axis] * thick)
