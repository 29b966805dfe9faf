"""Thick slices: by what a voxel of one is foreground, and where in its thickness that is decided.

Who draws on an image outlines what fills half of the slice's thickness. Masks of which only some slices are left show
the section at the slice's centre. Averages of an even number of fine slices, as thick as voxels are wide, have columns
of which exactly half is filled: foreground where at least half was asked for, background where more than half was. The
ends of the object lie half a fine slice apart between these, which is 15 % of a hippocampus' volume on slices of 4 mm,
and no header tells which it was. So the fit goes on under each, and the drawing decides: of the posterior over the
rules the median is taken, and what it leaves open is told.

Under each rule one fine slice of a column decides: that at the centre, the median, or the one of an even number's two
in the middle that lets ties in or keeps them out. Each observation is placed there, found at the current fit, and the
fit goes on; one or two rounds settle it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from model.bundle import ShapeModel
from model.inference.fit_types import ThickRule
from model.inference.fitting import Fit, FitOptions, refit
from model.inference.mask_stack import MaskStack, Plane
from model.inference.observations import Observations
from model.inference.posterior import model_logits

#: A slice is thick when its spacing is this many times that of its voxels in the plane.
THICK_RATIO = 2.5
#: Slices that one is taken for the average of at most. An odd number: of more the larger half begins at the median.
MOST_SLICES = 15
ROUNDS = 2
#: Rules that any thick slice may have been drawn by, and those of averages of an even number of fine slices.
COMMON_RULES: tuple[ThickRule, ...] = ("half", "section")
EVEN_RULES: tuple[ThickRule, ...] = ("at least half", "more than half")
#: How many halves of a fine slice farther out an object ends than it was drawn.
BEYOND: dict[ThickRule, int] = {"at least half": -1, "half": 0, "section": 0, "more than half": 1}
#: How near half a thickness has to be to a whole number of voxels for an even number of them.
EVEN_WITHIN = 0.01

#: Values of a field at points (world mm).
Field = Callable[[Float[np.ndarray, "m 3"]], Float[np.ndarray, "m"]]


@dataclass(frozen=True)
class Columns:
    """What is averaged at points of slices.

    Attributes:
        vectors: through the slice (world mm), zero where it is not thick.
        widths_mm: of a voxel in the slice's plane.
        rule: by what they are foreground.
    """

    vectors: Float[np.ndarray, "n 3"]
    widths_mm: Float[np.ndarray, "n"]
    rule: ThickRule = "half"

    def __getitem__(self, chosen: Int[np.ndarray, "m"] | Bool[np.ndarray, "n"]) -> "Columns":
        return replace(self, vectors=self.vectors[chosen], widths_mm=self.widths_mm[chosen])

    @property
    def voxels(self) -> Float[np.ndarray, "n"]:
        """Thickness in widths of a voxel; 0 where the slice is not thick."""
        return np.asarray(np.linalg.norm(self.vectors, axis=1) / self.widths_mm)

    @property
    def rules(self) -> tuple[ThickRule, ...]:
        """Rules that the slices may have been drawn by; none where no slice is thick."""
        pairs = self.voxels[self.voxels > 0.0] / 2.0
        if not pairs.size:
            return ()
        even = np.abs(pairs - np.rint(pairs)) < EVEN_WITHIN
        return COMMON_RULES + (EVEN_RULES if even.any() else ())

    @property
    def halves_mm(self) -> Float[np.ndarray, "k 3"]:
        """Half a fine slice along the normal of each direction of thick slices (world mm)."""
        thick = self.voxels > 0.0
        return np.unique(np.round(self.vectors[thick] / (2.0 * self.voxels[thick, None]), 6), axis=0)

    @property
    def counts(self) -> Int[np.ndarray, "n"]:
        """Of how many fine slices one decides: the centre alone on thin slices, an odd number where none can tie."""
        counts = np.clip(np.rint(self.voxels).astype(int), 1, MOST_SLICES)
        match self.rule:
            case "section":
                return np.ones_like(counts)
            case "half":
                return np.asarray(counts | 1)
            case _:
                return np.asarray(counts)


def through_thickness(
    model: ShapeModel, found: Fit, stacks: Sequence[MaskStack], observations: Observations, options: FitOptions
) -> tuple[Fit, Observations]:
    """The fit to observations placed where their columns are decided; unchanged where no slice is thick."""
    columns = columns_of(stacks, observations.planes)[observations.plane_of]
    if not columns.rules:
        return found, observations
    settled = [settled_under(model, found, rule, observations, columns, options) for rule in columns.rules]
    chosen, open_halves = median_rule({fit.thick_rule: fit.objective for fit, _ in settled})
    fit, placed = next(one for one in settled if one[0].thick_rule == chosen)
    return replace(fit, thick_doubt=open_halves * columns.halves_mm), placed


def median_rule(objectives: Mapping[ThickRule, float]) -> tuple[ThickRule, float]:
    """The likeliest of the rules that say what the median one says, and the SD of the others from it.

    Args:
        objectives: negative log posterior (nats) under each rule.

    Returns:
        A rule, and how far the ends of the object may lie elsewhere (halves of a fine slice).
    """
    least = min(objectives.values())
    weights = {rule: float(np.exp(least - value)) for rule, value in objectives.items()}
    total = sum(weights.values())
    middle = next(
        beyond
        for beyond in sorted(set(BEYOND.values()))
        if sum(weight for rule, weight in weights.items() if BEYOND[rule] <= beyond) >= total / 2.0
    )
    variance = sum(weight * (BEYOND[rule] - middle) ** 2 for rule, weight in weights.items()) / total
    return max((rule for rule in weights if BEYOND[rule] == middle), key=weights.__getitem__), float(np.sqrt(variance))


def settled_under(
    model: ShapeModel,
    found: Fit,
    rule: ThickRule,
    observations: Observations,
    columns: Columns,
    options: FitOptions,
) -> tuple[Fit, Observations]:
    """The fit to observations placed where their columns are decided by a rule."""
    found, columns, placed = replace(found, thick_rule=rule), replace(columns, rule=rule), observations
    if rule == "section":
        return found, observations
    for _ in range(ROUNDS):
        places, _ = decided(partial(model_logits, model, found), observations.points, columns)
        placed = replace(observations, points=places)
        found = refit(model, placed, found, options)
    return found, placed


def columns_of(stacks: Sequence[MaskStack], planes: Sequence[Plane], rule: ThickRule = "half") -> Columns:
    """What is averaged on each plane."""
    drawn = [(stacks[plane.stack], plane) for plane in planes]
    vectors = [thickness_mm(stack, plane) * stack.grid.directions[:, plane.axis] for stack, plane in drawn]
    widths = [np.delete(stack.grid.spacing, plane.axis).max() for stack, plane in drawn]
    return Columns(np.array(vectors).reshape(-1, 3), np.array(widths, float), rule)


def decided(
    field: Field, points: Float[np.ndarray, "n 3"], columns: Columns
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n"]]:
    """Where in the column at each point a field has the value by whose sign the voxel is drawn, and that value.

    Args:
        points: at the centres of slices (world mm).
    """
    places, values = points.copy(), np.empty(len(points))
    counts, larger_half = columns.counts, columns.rule != "more than half"
    for count in np.unique(counts):
        rows = counts == count
        shares = (np.arange(count) + 0.5) / count - 0.5
        through = points[rows] + shares[:, None, None] * columns.vectors[rows]
        found = field(through.reshape(-1, 3)).reshape(through.shape[:2])
        middle = (count - 1 + larger_half) // 2
        chosen = np.argsort(found, axis=0, kind="stable")[middle], np.arange(rows.sum())
        places[rows], values[rows] = through[chosen], found[chosen]
    return places, values


def thickness_mm(stack: MaskStack, plane: Plane) -> float:
    """Thickness of a slice, 0 when it is of the order of its voxels' size in the plane."""
    spacing = stack.grid.spacing
    thick = spacing[plane.axis] > THICK_RATIO * np.delete(spacing, plane.axis).max()
    return float(spacing[plane.axis] * thick)
