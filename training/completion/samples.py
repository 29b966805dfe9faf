"""Training samples of a completion network: a drawing and the mask it was made of, on the lattice of a random pose."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates

from model.geometry import CanonicalLattice
from model.inference.completion.drawn import drawn_at
from training.cohorts.cohort import Case
from training.completion.drawings import random_drawing
from training.placing import centroid, reach
from training.points import Window, cuts_are_ends, window

#: SDs of the place of the origin (mm), as far as fits are off, and of the entries of a linear map of the shape.
PLACED_MM, BENT = 1.5, 0.07
#: Background around the object that is known (mm).
MARGIN_MM = 16.0
#: Lattices hold this share of training shapes whole, with so much room (mm).
HELD_SHARE, ROOM_MM = 0.95, 2.0
#: Factor between steps (mm) that are tried.
COARSER = 1.01


@dataclass(frozen=True)
class Sample:
    """What the network sees and what it should answer.

    Attributes:
        drawn: voxels drawn inside and outside.
        inside: occupancy, interpolated.
        known: voxels of which it is known.
    """

    drawn: Bool[np.ndarray, "2 i j k"]
    inside: Float[np.ndarray, "i j k"]
    known: Bool[np.ndarray, "i j k"]


def windows_of(cases: Sequence[Case]) -> list[Window]:
    """The masks with enough background around them."""
    ends = cuts_are_ends(cases)
    return [window(case, MARGIN_MM, cut_is_end=ends) for case in cases]


def lattice_for(windows: Sequence[Window], most_voxels: int, least_step_mm: float, multiple: int) -> CanonicalLattice:
    """The finest lattice of so many voxels at most that holds most training shapes around their centroids."""
    reaches = np.array([reach(found.mask, found.grid) for found in windows])
    half = np.quantile(reaches, HELD_SHARE, axis=0) + ROOM_MM
    step = least_step_mm
    while True:
        i, j, k = (int(multiple * np.ceil(2.0 * size / step / multiple)) for size in half)
        if i * j * k <= most_voxels or max(i, j, k) == multiple:
            return CanonicalLattice((i, j, k), round(step, 3))
        step *= COARSER


def random_sample(
    found: Window, lattice: CanonicalLattice, rng: np.random.Generator, *, mirrored: bool = False
) -> Sample:
    """A random drawing of a mask, seen from a random pose a little off, of a shape a little changed.

    Args:
        mirrored: left for right.
    """
    drawing = random_drawing(found, rng)
    linear = np.eye(3) + BENT * rng.standard_normal((3, 3))
    if mirrored:
        linear[:, 0] *= -1.0
    centre = centroid(found.mask, found.grid) + PLACED_MM * rng.standard_normal(3)
    world = lattice.points() @ linear.T + centre
    index = found.grid.to_index(world).T
    inside = map_coordinates(found.mask.astype(np.float32), index, order=1, mode="constant")
    nearest = np.rint(index).astype(int)
    within = ((nearest >= 0) & (nearest < np.array(found.mask.shape)[:, None])).all(axis=0)
    known = within.copy()
    known[within] = ~found.unknown[tuple(nearest[:, within])]
    drawn = drawn_at(world, lattice.step_mm / 2.0, drawing.stacks, drawing.planes)
    return Sample(drawn.reshape(2, *lattice.voxels), inside.reshape(lattice.voxels), known.reshape(lattice.voxels))
