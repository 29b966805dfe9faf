"""Sparse drawings out of dense masks: thin slices, thick slices, orthogonal slices.

The axial axis is the index axis closest to the world's S direction (the last one on an RAS grid); coronal
and sagittal are closest to A and R. Which slices are drawn:

- thin: every 8th axial slice. Training draws the offset at random and counts the empty slices of the crop as
  looked at. Evaluation centres the slices in the object (`centred_offset`) and keeps those that hold some of it,
  as a person who draws does, and as the service finds them.
- thick: the average of 8 axial slices, at least one half, for every 8th slice. The thick slice stands at its centre,
  on a grid with 8 times the axial spacing. Offsets as for thin.
- orthogonal: one axial, one coronal and one sagittal slice through the object: random in training, those with the
  largest area in evaluation (the first one among equals).
- dense: every axial slice.

An object that spans no more than 8 axial slices is drawn at a third of its extent instead (`gap_for`), so that two thin
slices at least show it if it has as many. Where a drawing would still show none of the object, as thick slices of a
slanted sheet do, thin slices centred in it take its place.
"""

from dataclasses import dataclass
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Bool
from scipy.optimize import linear_sum_assignment

from model.geometry import Grid
from model.inference.observations import MaskStack, Plane

Regime = Literal["thin", "thick", "orthogonal", "dense"]
REGIMES: tuple[Regime, ...] = ("thin", "thick", "orthogonal", "dense")
#: Sparsity of the thin and thick regimes (MorphoFlow paper, after Amiranashvili et al. 2024).
EVERY = 8
#: An object of no more than `EVERY` slices is drawn at gaps of its extent in so many parts.
PARTS = 3


@dataclass(frozen=True)
class Drawing:
    """A sparse drawing: a stack whose voxels off the drawn planes are excluded, and those planes."""

    stack: MaskStack
    planes: tuple[Plane, ...]

    @property
    def annotated(self) -> Bool[np.ndarray, "i j k"]:
        """Voxels that were looked at."""
        return ~self.stack.excluded


def body_axes(grid: Grid) -> tuple[int, int, int]:
    """Index axes closest to R, A and S: the normals of sagittal, coronal and axial slices."""
    _, axes = linear_sum_assignment(-np.abs(grid.directions))
    return int(axes[0]), int(axes[1]), int(axes[2])


def for_training(mask: Bool[np.ndarray, "i j k"], grid: Grid, regime: Regime, rng: np.random.Generator) -> Drawing:
    """A random drawing of a mask that is not empty."""
    every = gap_for(mask, body_axes(grid)[2])
    match regime:
        case "thin":
            drawn = thin(mask, grid, int(rng.integers(every)), every=every, empty_slices=True)
            return _showing(drawn, mask, grid, every, empty_slices=True)
        case "thick":
            drawn = thick(mask, grid, int(rng.integers(every)), every=every, empty_slices=True)
            return _showing(drawn, mask, grid, every, empty_slices=True)
        case "orthogonal":
            return orthogonal(mask, grid, random_slices(mask, rng))
        case "dense":
            return dense(mask, grid)
        case never:
            assert_never(never)


def for_evaluation(
    mask: Bool[np.ndarray, "i j k"], grid: Grid, regime: Regime, *, offset: int | None = None
) -> Drawing:
    """The drawing that figures are measured with: a pure function of a mask that is not empty.

    Args:
        offset: first drawn slice of the grid for thin and thick; slices centred in the object when None.
    """
    axial = body_axes(grid)[2]
    every = gap_for(mask, axial)
    match regime:
        case "thin":
            first = centred_offset(mask, axial, every) if offset is None else offset
            return _showing(thin(mask, grid, first, every=every), mask, grid, every)
        case "thick":
            first = centred_block(mask, axial, every) if offset is None else offset
            return _showing(thick(mask, grid, first, every=every), mask, grid, every)
        case "orthogonal":
            return orthogonal(mask, grid, largest_slices(mask))
        case "dense":
            return dense(mask, grid)
        case never:
            assert_never(never)


def thin(
    mask: Bool[np.ndarray, "i j k"], grid: Grid, offset: int, *, every: int = EVERY, empty_slices: bool = False
) -> Drawing:
    """Axial slices ``offset``, ``offset + every`` and so on (modulo ``every`` from the grid's first).

    Args:
        empty_slices: whether slices without foreground count as looked at.
    """
    axial = body_axes(grid)[2]
    occupied = _occupied(mask, axial)
    chosen = [index for index in range(offset % every, mask.shape[axial], every) if empty_slices or occupied[index]]
    return _draw(mask, grid, [(axial, index) for index in chosen])


def thick(
    mask: Bool[np.ndarray, "i j k"], grid: Grid, offset: int, *, every: int = EVERY, empty_slices: bool = False
) -> Drawing:
    """Blocks of ``every`` axial slices, one of which begins at ``offset``, averaged and cut at one half.

    Blocks that reach beyond the grid are filled with background. The drawing's own grid has ``every`` times
    the axial spacing, and its slices stand at the centres of the blocks.
    """
    axial = body_axes(grid)[2]
    start, fine = blocks_of(mask, axial, offset, every)
    averaged = fine.mean(axis=1) >= 0.5
    occupied = averaged.any(axis=(1, 2))
    chosen = [(axial, index) for index in range(len(averaged)) if empty_slices or occupied[index]]
    return _draw(np.moveaxis(averaged, 0, axial), thick_grid(grid, axial, start, every, len(averaged)), chosen)


def blocks_of(
    mask: Bool[np.ndarray, "i j k"], axis: int, offset: int, every: int
) -> tuple[int, Bool[np.ndarray, "n e a b"]]:
    """First slice (0 or less) of the first block, and the slices of all, ``every`` each; one begins at ``offset``."""
    along = np.moveaxis(mask, axis, 0)
    start = offset % every - (every if offset % every else 0)
    blocks = -(-(len(along) - start) // every)
    padded = np.zeros((blocks * every, *along.shape[1:]), bool)
    padded[-start : len(along) - start] = along
    return start, padded.reshape(blocks, every, *along.shape[1:])


def orthogonal(mask: Bool[np.ndarray, "i j k"], grid: Grid, indices: tuple[int, int, int]) -> Drawing:
    """One slice across each index axis."""
    return _draw(mask, grid, list(enumerate(indices)))


def dense(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> Drawing:
    """Every axial slice, the empty ones too."""
    axial = body_axes(grid)[2]
    return _draw(mask, grid, [(axial, index) for index in range(mask.shape[axial])])


def gap_for(mask: Bool[np.ndarray, "i j k"], axis: int) -> int:
    """Slices from one drawn slice to the next: `EVERY`, or a third of those that a shorter object spans."""
    first, last = _range(mask, axis)
    count = last + 1 - first
    return EVERY if count > EVERY else -(-count // PARTS)


def centred_offset(mask: Bool[np.ndarray, "i j k"], axis: int, every: int = EVERY) -> int:
    """First of the slices that stand centred in the object: equal gaps (to one slice) at both of its ends."""
    first, last = _range(mask, axis)
    return first + ((last - first) % every) // 2


def centred_block(mask: Bool[np.ndarray, "i j k"], axis: int, every: int = EVERY) -> int:
    """First slice of the fewest blocks that hold the whole object, centred on it; may be negative."""
    first, last = _range(mask, axis)
    return first - (-(last + 1 - first) % every) // 2


def largest_slices(mask: Bool[np.ndarray, "i j k"]) -> tuple[int, int, int]:
    """The slice with the largest area across each index axis."""
    areas = (mask.sum(axis=(1, 2)), mask.sum(axis=(0, 2)), mask.sum(axis=(0, 1)))
    return int(areas[0].argmax()), int(areas[1].argmax()), int(areas[2].argmax())


def random_slices(mask: Bool[np.ndarray, "i j k"], rng: np.random.Generator) -> tuple[int, int, int]:
    """A random slice that holds foreground across each index axis."""
    first, second, third = (np.flatnonzero(mask.any(axis=other)) for other in ((1, 2), (0, 2), (0, 1)))
    return int(rng.choice(first)), int(rng.choice(second)), int(rng.choice(third))


def _showing(
    drawn: Drawing, mask: Bool[np.ndarray, "i j k"], grid: Grid, every: int, *, empty_slices: bool = False
) -> Drawing:
    """The drawing if it shows some of the object, or centred thin slices at the largest gap, up to this, that do."""
    axial = body_axes(grid)[2]
    for gap in range(every, 0, -1):
        if drawn.stack.foreground.any():
            break
        drawn = thin(mask, grid, centred_offset(mask, axial, gap), every=gap, empty_slices=empty_slices)
    return drawn


def _draw(mask: Bool[np.ndarray, "i j k"], grid: Grid, chosen: list[tuple[int, int]]) -> Drawing:
    annotated = np.zeros(mask.shape, bool)
    for axis, index in chosen:
        np.moveaxis(annotated, axis, 0)[index] = True
    stack = MaskStack("mask[0]", grid, mask & annotated, ~annotated)
    return Drawing(stack, tuple(Plane(0, axis, index) for axis, index in chosen))


def thick_grid(grid: Grid, axis: int, start: float, every: int, blocks: int) -> Grid:
    """The grid of slices ``every`` times as thick along an axis, the first of which begins with slice ``start``."""
    centre = np.zeros((1, 3))
    centre[0, axis] = start + (every - 1) / 2
    affine = grid.affine.astype(float).copy()
    affine[:3, 3] = grid.to_world(centre)[0]
    affine[:3, axis] *= every
    shape = list(grid.shape)
    shape[axis] = blocks
    return Grid((shape[0], shape[1], shape[2]), affine)


def _range(mask: Bool[np.ndarray, "i j k"], axis: int) -> tuple[int, int]:
    occupied = np.flatnonzero(_occupied(mask, axis))
    return int(occupied[0]), int(occupied[-1])


def _occupied(mask: Bool[np.ndarray, "i j k"], axis: int) -> Bool[np.ndarray, "n"]:
    return np.asarray(np.moveaxis(mask, axis, 0).any(axis=(1, 2)))
