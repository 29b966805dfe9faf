"""One segmentation volume, its planes of voxels and the boxes around its foreground."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from model.geometry import Grid, Space


@dataclass(frozen=True)
class MaskStack:
    """One segmentation volume of the object.

    Attributes:
        part: how the caller knows it in messages, for example ``mask[0]``; never a file name.
        grid: its voxels in the world (RAS mm).
        foreground: (i, j, k) voxels of the object.
        excluded: (i, j, k) voxels that were never looked at (value 255), whatever the planes say.
        space: world in which answers about this volume are told; its grid is RAS all the same.
        absent: labels of the object that it does not hold, though it holds others.
        notes: sentences that answers about it must tell, for example of what its file left open.
    """

    part: str
    grid: Grid
    foreground: Bool[np.ndarray, "i j k"]
    excluded: Bool[np.ndarray, "i j k"]
    space: Space = "RAS"
    absent: frozenset[int] = frozenset()
    notes: tuple[str, ...] = ()


def common_space(stacks: Sequence[MaskStack]) -> Space:
    """World in which answers about all of the stacks are told: LPS where every one's is, RAS otherwise."""
    return "LPS" if stacks and all(stack.space == "LPS" for stack in stacks) else "RAS"


@dataclass(frozen=True, order=True)
class Plane:
    """A plane of voxels: ``index`` along ``axis`` (0, 1, 2) of stack number ``stack``."""

    stack: int
    axis: int
    index: int


def section_of(volume: Bool[np.ndarray, "i j k"], plane: Plane) -> Bool[np.ndarray, "a b"]:
    """The plane's voxels, in-plane axes in ascending order."""
    section: Bool[np.ndarray, "a b"] = np.moveaxis(volume, plane.axis, 0)[plane.index]
    return section


def occupied(volume: Bool[np.ndarray, "i j k"], axis: int) -> Int[np.ndarray, "m"]:
    """Indices along the axis whose plane of voxels holds any."""
    others = tuple(a for a in range(3) if a != axis)
    return np.flatnonzero(volume.any(axis=others))


def index_box(volume: Bool[np.ndarray, "i j k"]) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
    """First and last index that hold foreground, by axis; the whole volume when none does."""
    held = [occupied(volume, axis) for axis in range(3)]
    if not held[0].size:
        return np.zeros(3, int), np.array(volume.shape) - 1
    return np.array([h[0] for h in held]), np.array([h[-1] for h in held])


def world_box(
    grid: Grid, low: Float[np.ndarray, "3"] | Int[np.ndarray, "3"], high: Float[np.ndarray, "3"] | Int[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Axis-aligned box (mm) around the centres of an index box."""
    corners = grid.to_world(box_corners(low, high))
    return corners.min(axis=0), corners.max(axis=0)


def box_corners(
    low: Float[np.ndarray, "3"] | Int[np.ndarray, "3"], high: Float[np.ndarray, "3"] | Int[np.ndarray, "3"]
) -> Float[np.ndarray, "8 3"]:
    """The eight corners of a box, axis-parallel in its own coordinates."""
    choice = np.indices((2, 2, 2)).reshape(3, -1).T
    return np.where(choice == 0, low, high).astype(float)
