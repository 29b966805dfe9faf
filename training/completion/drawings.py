"""Random drawings of a training mask, of all the kinds that a completion network will be asked about."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from model.errors import CohortError
from model.inference.mask_stack import MaskStack
from training.cohorts.cohort import Case
from training.oblique import SliceStacks, in_one_stack, random_planes
from training.points import Window
from training.sparsify import EVERY, largest_slices, orthogonal, random_slices, thick, thin

#: Slices through the object along each axis have at least this share of the largest one's area half of the time.
LARGE_SHARE = 0.5
#: Distances between parallel slices, and numbers of planes of any orientation.
GAPS, PLANES = (4, 12), (2, 8)

Draw = Callable[[Window, np.random.Generator], SliceStacks]


def random_drawing(found: Window, rng: np.random.Generator) -> SliceStacks:
    """A drawing of a random kind; what the crop does not show is not drawn."""
    kinds: tuple[Draw, ...] = (_largest, _orthogonal, _parallel, _parallel, _thick, _oblique)
    drawn = kinds[int(rng.integers(len(kinds)))](found, rng)
    return replace(drawn, stacks=tuple(_known(stack, found) for stack in drawn.stacks))


def _largest(found: Window, _: np.random.Generator) -> SliceStacks:
    return in_one_stack(orthogonal(found.mask, found.grid, largest_slices(found.mask)))


def _orthogonal(found: Window, rng: np.random.Generator) -> SliceStacks:
    """Slices anywhere or near the largest ones."""
    if rng.random() < 0.5:
        return in_one_stack(orthogonal(found.mask, found.grid, random_slices(found.mask, rng)))
    areas = [found.mask.sum(axis=others) for others in ((1, 2), (0, 2), (0, 1))]
    first, second, third = (int(rng.choice(np.flatnonzero(area >= LARGE_SHARE * area.max()))) for area in areas)
    return in_one_stack(orthogonal(found.mask, found.grid, (first, second, third)))


def _parallel(found: Window, rng: np.random.Generator) -> SliceStacks:
    """Axial slices at equal distances, as often as not `EVERY`."""
    every = EVERY if rng.random() < 0.5 else int(rng.integers(GAPS[0], GAPS[1] + 1))
    drawn = thin(found.mask, found.grid, int(rng.integers(every)), every=every)
    return in_one_stack(drawn) if drawn.planes else _largest(found, rng)


def _thick(found: Window, rng: np.random.Generator) -> SliceStacks:
    drawn = thick(found.mask, found.grid, int(rng.integers(EVERY)))
    return in_one_stack(drawn) if drawn.planes else _largest(found, rng)


def _oblique(found: Window, rng: np.random.Generator) -> SliceStacks:
    count, seed = int(rng.integers(PLANES[0], PLANES[1] + 1)), int(rng.integers(1 << 31))
    try:
        return random_planes(Case("", "", "train", found.mask, found.grid), count, seed)
    except CohortError:  # such a thin object that hardly any plane holds it
        return _largest(found, rng)


def _known(stack: MaskStack, found: Window) -> MaskStack:
    """The stack without voxels that lie beyond a face of the crop that cuts the object off."""
    if not found.unknown.any():
        return stack
    index = np.rint(found.grid.to_index(stack.grid.centres())).astype(int)
    index = np.clip(index, 0, np.array(found.mask.shape) - 1)
    return replace(stack, excluded=stack.excluded | found.unknown[tuple(index.T)].reshape(stack.excluded.shape))
