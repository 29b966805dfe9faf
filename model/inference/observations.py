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

from model.errors import InconsistentStacks, InvalidMask, InvalidParameter
from model.geometry import Grid
from model.inference.plane_cover import cover_planes
from model.inference.plane_sampling import (
    band_width,
    contour_distance,
    inclusion_probabilities,
    systematic_sample,
)

AnnotatedRule = Literal["auto", "all", "nonempty"]

#: The cover of the rest reaches this far (mm) beyond the box around all foreground.
COVER_MARGIN_MM = 30.0
#: Distance (mm) from the contour over which the cover thins out to half.
COVER_DECAY_MM = 5.0
#: Share of the budget that is kept for the cover when the band alone would use it up.
COVER_SHARE = 0.2
#: Smallest number of observations that can be asked for.
SMALLEST_BUDGET = 16
#: Boxes around the foreground of two stacks may lie this far apart (mm).
WORLD_GAP_MM = 20.0
#: Spacings that differ by less than this share are equal.
SPACING_TOLERANCE = 1e-3
#: Indices that differ by less than this (voxels) are equal.
ROUNDING = 1e-6
#: Fewest planes from which a shape can be reconstructed.
FEWEST_PLANES = 2


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
        weights: (n,) area (mm^2) of annotated plane that each point stands for.
        planes: the annotated planes.
        plane_of: (n,) position in `planes` of the plane that each point came from.
    """

    points: Float[np.ndarray, "n 3"]
    labels: Float[np.ndarray, "n"]
    weights: Float[np.ndarray, "n"]
    planes: tuple[Plane, ...]
    plane_of: Int[np.ndarray, "n"]


def find_planes(stacks: Sequence[MaskStack], rule: AnnotatedRule | Sequence[Plane]) -> tuple[Plane, ...]:
    """The annotated planes by a rule of the interface, or those named, checked against the stacks.

    ``all`` takes every plane along the axis of the largest spacing, ``nonempty`` those of them that hold
    foreground, ``auto`` the fewest planes along any axes that together hold all foreground
    (`model.inference.plane_cover`). Each stack is judged by itself; planes are counted over all of them.
    Planes without foreground are annotated by ``all`` and by name only: between two drawn slices of a
    sparse stack nobody has looked.

    Returns:
        the planes in ascending order, each once.

    Raises:
        InvalidMask: fewer than two planes, or no foreground on them.
        InvalidParameter: a named plane that its stack does not have, or fewer than two named.
        InconsistentStacks: foregrounds of two stacks over `WORLD_GAP_MM` apart.
    """
    _check_same_world(stacks)
    if isinstance(rule, str):
        planes = tuple(
            Plane(number, axis, index)
            for number, stack in enumerate(stacks)
            for axis, index in sorted(_planes_by_rule(stack, rule))
        )
        _check_count(stacks, planes)
    else:
        planes = _named_planes(stacks, rule)
    if not any(section_of(stacks[p.stack].foreground, p).any() for p in planes):
        raise InvalidMask("mask holds no foreground on its annotated planes; at least one voxel is needed", part="mask")
    return planes


def section_of(volume: Bool[np.ndarray, "i j k"], plane: Plane) -> Bool[np.ndarray, "a b"]:
    """The plane's voxels, in-plane axes in ascending order."""
    section: Bool[np.ndarray, "a b"] = np.moveaxis(volume, plane.axis, 0)[plane.index]
    return section


def _planes_by_rule(stack: MaskStack, rule: AnnotatedRule) -> list[tuple[int, int]]:
    drawn = stack.foreground & ~stack.excluded
    if rule == "auto":
        return cover_planes(drawn)
    thick = _thickest_axes(stack.grid)
    held = {axis: _occupied(drawn, axis) for axis in thick}
    if rule == "nonempty":
        axis = min(thick, key=lambda a: (len(held[a]), -a))
        return [(axis, int(index)) for index in held[axis]]
    auto_axes = [a for a, _ in cover_planes(drawn)] if len(thick) > 1 else []
    axis = max(thick, key=lambda a: (auto_axes.count(a), a))
    return [(axis, int(index)) for index in _occupied(~stack.excluded, axis)]


def _thickest_axes(grid: Grid) -> list[int]:
    spacing = grid.spacing
    return [axis for axis in range(3) if spacing[axis] >= spacing.max() * (1.0 - SPACING_TOLERANCE)]


def _occupied(volume: Bool[np.ndarray, "i j k"], axis: int) -> Int[np.ndarray, "m"]:
    others = tuple(a for a in range(3) if a != axis)
    return np.flatnonzero(volume.any(axis=others))


def _check_count(stacks: Sequence[MaskStack], planes: tuple[Plane, ...]) -> None:
    if len(planes) < FEWEST_PLANES:
        part = stacks[0].part if len(stacks) == 1 else "mask"
        found = "one slice only" if planes else "no annotated plane"
        raise InvalidMask(f"{part} holds {found}; at least two annotated planes are needed", part=part)


def _named_planes(stacks: Sequence[MaskStack], named: Sequence[Plane]) -> tuple[Plane, ...]:
    for position, plane in enumerate(named):
        part = f"annotated[{position}]"
        if not 0 <= plane.stack < len(stacks):
            raise InvalidParameter(f"{part} names stack {plane.stack}; 0 to {len(stacks) - 1} is accepted", part=part)
        if not 0 <= plane.axis < 3:
            raise InvalidParameter(f"{part} names axis {plane.axis}; 0 to 2 is accepted", part=part)
        size = stacks[plane.stack].grid.shape[plane.axis]
        if not 0 <= plane.index < size:
            raise InvalidParameter(
                f"{part} names plane {plane.index} along axis {plane.axis} of {stacks[plane.stack].part}; "
                f"0 to {size - 1} is accepted",
                part=part,
            )
    planes = tuple(sorted(set(named)))
    if len(planes) < FEWEST_PLANES:
        raise InvalidParameter("annotated must name at least two different planes", part="annotated")
    return planes


def _check_same_world(stacks: Sequence[MaskStack]) -> None:
    boxes = [_world_box(stack.grid, *_index_box(stack.foreground)) for stack in stacks]
    for second in range(len(stacks)):
        for first in range(second):
            lows = np.maximum(boxes[first][0], boxes[second][0])
            highs = np.minimum(boxes[first][1], boxes[second][1])
            if (lows - highs).max() > WORLD_GAP_MM:
                raise InconsistentStacks(
                    f"{stacks[first].part} and {stacks[second].part} lie over {WORLD_GAP_MM:g} mm apart in the world; "
                    "stacks of one object in one frame are accepted",
                    part=stacks[second].part,
                )


def _index_box(volume: Bool[np.ndarray, "i j k"]) -> tuple[Int[np.ndarray, "3"], Int[np.ndarray, "3"]]:
    """First and last index that hold foreground, by axis; the whole volume when none does."""
    held = [_occupied(volume, axis) for axis in range(3)]
    if not held[0].size:
        return np.zeros(3, int), np.array(volume.shape) - 1
    return np.array([h[0] for h in held]), np.array([h[-1] for h in held])


def _world_box(
    grid: Grid, low: Float[np.ndarray, "3"] | Int[np.ndarray, "3"], high: Float[np.ndarray, "3"] | Int[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    corners = grid.to_world(_corners(low, high))
    return corners.min(axis=0), corners.max(axis=0)


def _corners(
    low: Float[np.ndarray, "3"] | Int[np.ndarray, "3"], high: Float[np.ndarray, "3"] | Int[np.ndarray, "3"]
) -> Float[np.ndarray, "8 3"]:
    choice = np.indices((2, 2, 2)).reshape(3, -1).T
    return np.where(choice == 0, low, high).astype(float)


@dataclass(frozen=True)
class _Candidates:
    """Voxels that may become observations, one row each.

    Attributes:
        voxel: (m,) flat number of the voxel in its stack.
        plane_of: (m,) position of its plane.
        label: (m,) whether it is foreground.
        distance: (m,) in-plane distance (mm) to the nearest voxel of the other label, infinite without one.
    """

    voxel: Int[np.ndarray, "m"]
    plane_of: Int[np.ndarray, "m"]
    label: Bool[np.ndarray, "m"]
    distance: Float[np.ndarray, "m"]

    def at(self, rows: Int[np.ndarray, "n"]) -> "_Candidates":
        """Some of the rows."""
        return _Candidates(self.voxel[rows], self.plane_of[rows], self.label[rows], self.distance[rows])


def observe(stacks: Sequence[MaskStack], planes: Sequence[Plane], *, budget: int, seed: int) -> Observations:
    """Observations on the planes: all voxels near contours, a thin re-weighted cover of the rest.

    Voxels in a narrow band around the in-plane contour (`model.inference.plane_sampling.band_width`) are all
    used. The rest is sampled systematically with inclusion probability ``p`` proportional to
    ``area / (1 + distance / COVER_DECAY_MM)`` and weighted ``area / p`` (Horvitz and Thompson 1952), so that
    every weighted sum is unbiased for the area-weighted sum over all voxels of the planes. "All" means those
    not excluded, in each stack's smallest index window around the box of all foreground grown by
    `COVER_MARGIN_MM`. A voxel where two planes cross is used once, for the plane in whose section it is
    nearer to the contour. A band larger than the budget less `COVER_SHARE` is sampled in the same way.

    Args:
        planes: as `find_planes` returns them.
        budget: number of observations, at most.
        seed: decides which voxels the samples hold; the same seed gives the same observations.

    Raises:
        InvalidParameter: budget below `SMALLEST_BUDGET`.
        InvalidMask: no voxel of the planes was looked at.
    """
    if budget < SMALLEST_BUDGET:
        raise InvalidParameter(f"budget must be at least {SMALLEST_BUDGET} observations", part="budget")
    candidates = _candidates(stacks, planes)
    if not candidates.voxel.size:
        raise InvalidMask("mask holds no voxel that was looked at on its annotated planes", part="mask")
    spacings = [_in_plane_spacing(stacks[plane.stack].grid, plane) for plane in planes]
    area = np.array([float(spacing.prod()) for spacing in spacings])[candidates.plane_of]
    band = np.array([band_width(spacing) for spacing in spacings])[candidates.plane_of]
    rows, weights = _draw(candidates.distance, band, area, budget, np.random.default_rng(seed))
    drawn = candidates.at(rows)
    points = _world_points(stacks, planes, drawn)
    return Observations(points, drawn.label.astype(float), weights, tuple(planes), drawn.plane_of)


def _candidates(stacks: Sequence[MaskStack], planes: Sequence[Plane]) -> _Candidates:
    windows = _windows(stacks)
    parts = [_section_candidates(stacks[p.stack], p, n, windows[p.stack]) for n, p in enumerate(planes)]
    every = _Candidates(
        np.concatenate([part.voxel for part in parts]),
        np.concatenate([part.plane_of for part in parts]),
        np.concatenate([part.label for part in parts]),
        np.concatenate([part.distance for part in parts]),
    )
    axes = {(plane.stack, plane.axis) for plane in planes}
    if len(axes) == len({stack for stack, _ in axes}):
        return every
    return every.at(_first_of_each(every, np.array([plane.stack for plane in planes])))


def _first_of_each(found: _Candidates, stack_of_plane: Int[np.ndarray, "p"]) -> Int[np.ndarray, "n"]:
    """Rows of distinct voxels, each from the plane in which it is nearest to the contour."""
    stack = stack_of_plane[found.plane_of]
    order = np.lexsort((found.plane_of, found.distance, found.voxel, stack))
    same = (np.diff(found.voxel[order]) == 0) & (np.diff(stack[order]) == 0)
    return order[np.concatenate([[True], ~same])] if order.size else order


def _windows(stacks: Sequence[MaskStack]) -> list[tuple[slice, slice, slice]]:
    """In each stack, the smallest index window around the box of all foreground and the margin."""
    boxes = [_world_box(stack.grid, *_index_box(stack.foreground)) for stack in stacks]
    low = np.min([box[0] for box in boxes], axis=0) - COVER_MARGIN_MM
    high = np.max([box[1] for box in boxes], axis=0) + COVER_MARGIN_MM
    return [_index_window(stack.grid, _corners(low, high)) for stack in stacks]


def _index_window(grid: Grid, corners: Float[np.ndarray, "8 3"]) -> tuple[slice, slice, slice]:
    index = grid.to_index(corners)
    first = np.clip(np.ceil(index.min(axis=0) - ROUNDING), 0, grid.shape).astype(int)
    end = np.clip(np.floor(index.max(axis=0) + ROUNDING) + 1, first, grid.shape).astype(int)
    return slice(first[0], end[0]), slice(first[1], end[1]), slice(first[2], end[2])


def _section_candidates(stack: MaskStack, plane: Plane, number: int, window: tuple[slice, slice, slice]) -> _Candidates:
    """The section's voxels that were looked at, within the window."""
    first, second = (axis for axis in range(3) if axis != plane.axis)
    cut = (window[first], window[second])
    seen = plane.index in range(window[plane.axis].start, window[plane.axis].stop)
    excluded = section_of(stack.excluded, plane)[cut] | (not seen)
    foreground = section_of(stack.foreground, plane)[cut] & ~excluded
    distance = contour_distance(foreground, excluded, _in_plane_spacing(stack.grid, plane))
    rows, columns = np.nonzero(~excluded)
    index = [np.full(rows.size, plane.index)] * 3
    index[first], index[second] = rows + window[first].start, columns + window[second].start
    voxel = np.ravel_multi_index(tuple(index), stack.grid.shape)
    plane_of = np.full(rows.size, number)
    return _Candidates(voxel, plane_of, foreground[rows, columns], distance[rows, columns])


def _in_plane_spacing(grid: Grid, plane: Plane) -> Float[np.ndarray, "2"]:
    return np.delete(grid.spacing, plane.axis)


def _draw(
    distance: Float[np.ndarray, "m"],
    band: Float[np.ndarray, "m"],
    area: Float[np.ndarray, "m"],
    budget: int,
    rng: np.random.Generator,
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Rows that are used and the area (mm^2) that each stands for."""
    near = distance <= band
    near_rows, far_rows = np.flatnonzero(near), np.flatnonzero(~near)
    reserved = min(far_rows.size, int(COVER_SHARE * budget))
    near_count = min(near_rows.size, budget - reserved)
    far_size = area[far_rows] / (1.0 + np.minimum(distance[far_rows], COVER_MARGIN_MM) / COVER_DECAY_MM)
    rows, weights = [], []
    for group, size, count in ((near_rows, area[near_rows], near_count), (far_rows, far_size, budget - near_count)):
        probability = inclusion_probabilities(size, count)
        chosen = systematic_sample(probability, rng)
        rows.append(group[chosen])
        weights.append(area[group[chosen]] / probability[chosen])
    return np.concatenate(rows), np.concatenate(weights)


def _world_points(stacks: Sequence[MaskStack], planes: Sequence[Plane], drawn: _Candidates) -> Float[np.ndarray, "n 3"]:
    points = np.empty((drawn.voxel.size, 3))
    stack_of = np.array([plane.stack for plane in planes])[drawn.plane_of]
    for number, stack in enumerate(stacks):
        rows = np.flatnonzero(stack_of == number)
        index = np.stack(np.unravel_index(drawn.voxel[rows], stack.grid.shape), axis=-1)
        points[rows] = stack.grid.to_world(index.astype(float))
    return points
