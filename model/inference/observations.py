"""Annotated planes of mask stacks as weighted point observations.

A stack is one file: a voxel grid in which some planes were looked at. Which planes those are is the
caller's word or found from the foreground (`find_planes`). Voxels of the annotated planes become
observations: a world point, an occupancy label and a weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from model.geometry import Grid

AnnotatedRule = Literal["auto", "all", "nonempty"]


@dataclass(frozen=True)
class MaskStack:
    """One segmentation volume of the object.

    Attributes:
        part: how the caller knows it in messages, for example ``mask[0]``; never a file name.
        grid: its voxels in the world (RAS mm).
        foreground: (i, j, k) voxels of the object.
        excluded: (i, j, k) voxels that were never looked at (value 255), whatever the planes say.
    """

    part: str
    grid: Grid
    foreground: Bool[np.ndarray, "i j k"]
    excluded: Bool[np.ndarray, "i j k"]


@dataclass(frozen=True, order=True)
class Plane:
    """A plane of voxels: ``index`` along ``axis`` (0, 1, 2) of stack number ``stack``."""

    stack: int
    axis: int
    index: int


@dataclass(frozen=True)
class Observations:
    """Weighted points with occupancy labels.

    Attributes:
        points: (n, 3) world RAS mm.
        labels: (n,) occupancy, 0 or 1.
        weights: (n,) how many voxels of the annotated planes each point stands for.
        planes: the annotated planes.
        plane_of: (n,) position in `planes` of the plane that each point came from.
    """

    points: Float[np.ndarray, "n 3"]
    labels: Float[np.ndarray, "n"]
    weights: Float[np.ndarray, "n"]
    planes: tuple[Plane, ...]
    plane_of: Int[np.ndarray, "n"]


def find_planes(stacks: Sequence[MaskStack], rule: AnnotatedRule | Sequence[Plane]) -> tuple[Plane, ...]:
    """The annotated planes by a rule of the interface, or those named, checked against the stacks."""
    raise NotImplementedError


def observe(stacks: Sequence[MaskStack], planes: Sequence[Plane], *, budget: int, seed: int) -> Observations:
    """Observations on the planes: all voxels near contours, a thin re-weighted cover of the rest."""
    raise NotImplementedError
