"""Annotated planes of mask stacks as weighted point observations.

A stack is one file: a voxel grid in which some planes were looked at. Which planes those are is the
caller's word or found from the foreground (`find_planes`). Voxels of the annotated planes become
observations: a world point, an occupancy label and a weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from model.errors import InvalidMask, InvalidParameter
from model.geometry import Grid
from model.inference.annotated_planes import AnnotatedRule, find_planes
from model.inference.mask_stack import MaskStack, Plane, box_corners, index_box, section_of, world_box
from model.inference.plane_sampling import (
    band_width,
    contour_distance,
    inclusion_probabilities,
    systematic_sample,
)

__all__ = ["AnnotatedRule", "MaskStack", "Observations", "Plane", "find_planes", "observe", "thinned"]

#: Index ranges of a part of a grid.
Window = tuple[slice, slice, slice]
#: The cover of the rest reaches this far (mm) beyond the box around all foreground.
COVER_MARGIN_MM = 30.0
#: Distance (mm) from the contour over which the cover thins out to half.
COVER_DECAY_MM = 5.0
#: Share of the budget that is kept for the cover when the band alone would use it up.
COVER_SHARE = 0.2
#: With a limited cover at least this many observations of it are used.
COVER_LEAST = 300
#: Smallest number of observations that can be asked for.
SMALLEST_BUDGET = 16
#: Planes are thinned out evenly when their sections have more voxels than this together.
CANDIDATE_LIMIT = 1 << 21
#: At least this many planes are left by thinning out.
FEWEST_THINNED = 16
#: Indices that differ by less than this (voxels) are equal.
ROUNDING = 1e-6


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


def observe(
    stacks: Sequence[MaskStack], planes: Sequence[Plane], *, budget: int, seed: int, cover: float = np.inf
) -> Observations:
    """Observations on the planes: all voxels near contours, a thin re-weighted cover of the rest.

    Voxels in a narrow band around the in-plane contour (`model.inference.plane_sampling.band_width`) are all
    used. The rest is sampled systematically with inclusion probability ``p`` proportional to
    ``area / (1 + distance / COVER_DECAY_MM)`` and weighted ``area / p`` (Horvitz and Thompson 1952), so that
    every weighted sum is unbiased for the area-weighted sum over all voxels of the planes. "All" means those
    not excluded, in each stack's smallest index window around the box of all foreground grown by
    `COVER_MARGIN_MM`. A voxel where two planes cross is used once, for the plane in whose section it is
    nearer to the contour (the finer plane, when equally near). A band larger than the budget less
    `COVER_SHARE` is sampled in the same way. Of dense volumes, whose sections have over `CANDIDATE_LIMIT` voxels,
    every second, third, ... plane is seen, and each of those stands for as many. Planes that show the object and
    empty ones are thinned out each by themselves, so that few drawn ones among many empty ones are all seen.

    Args:
        planes: as `find_planes` returns them.
        budget: number of observations, at most.
        seed: decides which voxels the samples hold; the same seed gives the same observations.
        cover: observations of the cover for each one of the band, at most; no fewer than `COVER_LEAST` altogether. A
            small object has few voxels in the band, and the rest of the budget would tell nothing more of it.

    Raises:
        InvalidParameter: budget below `SMALLEST_BUDGET`.
        InvalidMask: no voxel of the planes was looked at.
    """
    if budget < SMALLEST_BUDGET:
        raise InvalidParameter(f"budget must be at least {SMALLEST_BUDGET} observations", part="budget")
    rng = np.random.default_rng(seed)
    windows = _windows(stacks)
    numbers, steps = _seen_planes(stacks, planes, windows, rng)
    candidates = _candidates(stacks, planes, windows, numbers)
    if not candidates.voxel.size:
        raise InvalidMask("mask holds no voxel that was looked at on its annotated planes", part="mask")
    spacings = [_in_plane_spacing(stacks[plane.stack].grid, plane) for plane in planes]
    area = np.array([float(spacing.prod()) for spacing in spacings])[candidates.plane_of]
    band = np.array([band_width(spacing) for spacing in spacings])[candidates.plane_of]
    rows, weights = _draw(candidates.distance, band, area, budget, cover, rng)
    drawn = candidates.at(rows)
    points = _world_points(stacks, planes, drawn)
    stands_for = weights * steps[drawn.plane_of]
    return Observations(points, drawn.label.astype(float), stands_for, tuple(planes), drawn.plane_of)


def thinned(observations: Observations, every: int, *, seed: int) -> Observations:
    """One observation of every so many neighbours in the list, which stands for all of them.

    Weighted sums stay unbiased: in each block of `every` rows one is drawn with equal chances.
    """
    if every <= 1:
        return observations
    starts = np.arange(0, len(observations.points), every)
    sizes = np.minimum(every, len(observations.points) - starts)
    rows = starts + np.random.default_rng(seed).integers(sizes)
    return replace(
        observations,
        points=observations.points[rows],
        labels=observations.labels[rows],
        weights=observations.weights[rows] * sizes,
        plane_of=observations.plane_of[rows],
    )


def _seen_planes(
    stacks: Sequence[MaskStack], planes: Sequence[Plane], windows: Sequence[Window], rng: np.random.Generator
) -> tuple[list[int], Int[np.ndarray, "k"]]:
    """Numbers of the planes that are looked at, and for how many planes each of all stands."""
    reached = np.array([_is_reached(plane, windows[plane.stack]) for plane in planes])
    shown = np.array([bool(section_of(stacks[plane.stack].foreground, plane).any()) for plane in planes])
    seen: list[int] = []
    steps = np.ones(len(planes), int)
    for group in (np.flatnonzero(reached & shown).tolist(), np.flatnonzero(reached & ~shown).tolist()):
        step = _plane_step([planes[number] for number in group], windows)
        seen += group[int(rng.integers(step)) :: step]
        steps[group] = step
    return sorted(seen), steps


def _is_reached(plane: Plane, window: Window) -> bool:
    return bool(window[plane.axis].start <= plane.index < window[plane.axis].stop)


def _plane_step(planes: Sequence[Plane], windows: Sequence[Window]) -> int:
    """Every how manieth plane is used: one in ``step``, from a random one on."""
    extents = np.array([[cut.stop - cut.start for cut in window] for window in windows])
    voxels = sum(int(np.delete(extents[plane.stack], plane.axis).prod()) for plane in planes)
    return max(1, min(-(-voxels // CANDIDATE_LIMIT), len(planes) // FEWEST_THINNED))


def _candidates(
    stacks: Sequence[MaskStack], planes: Sequence[Plane], windows: Sequence[Window], numbers: Sequence[int]
) -> _Candidates:
    parts = [_section_candidates(stacks[planes[n].stack], planes[n], n, windows[planes[n].stack]) for n in numbers]
    if not parts:
        return _Candidates(np.zeros(0, int), np.zeros(0, int), np.zeros(0, bool), np.zeros(0))
    every = _Candidates(
        np.concatenate([part.voxel for part in parts]),
        np.concatenate([part.plane_of for part in parts]),
        np.concatenate([part.label for part in parts]),
        np.concatenate([part.distance for part in parts]),
    )
    axes = {(plane.stack, plane.axis) for plane in planes}
    if len(axes) == len({stack for stack, _ in axes}):
        return every
    return every.at(_first_of_each(every, stacks, planes))


def _first_of_each(found: _Candidates, stacks: Sequence[MaskStack], planes: Sequence[Plane]) -> Int[np.ndarray, "n"]:
    """Rows of distinct voxels, each from the plane in which it is nearest to the contour, the finer one of equals."""
    stack = np.array([plane.stack for plane in planes])[found.plane_of]
    area = np.array([_in_plane_spacing(stacks[plane.stack].grid, plane).prod() for plane in planes])[found.plane_of]
    order = np.lexsort((found.plane_of, np.round(area, 6), np.round(found.distance, 6), found.voxel, stack))
    same = (np.diff(found.voxel[order]) == 0) & (np.diff(stack[order]) == 0)
    return order[np.concatenate([[True], ~same])] if order.size else order


def _windows(stacks: Sequence[MaskStack]) -> list[Window]:
    """In each stack, the smallest index window around the box of all foreground and the margin."""
    boxes = [world_box(stack.grid, *index_box(stack.foreground)) for stack in stacks]
    low = np.min([box[0] for box in boxes], axis=0) - COVER_MARGIN_MM
    high = np.max([box[1] for box in boxes], axis=0) + COVER_MARGIN_MM
    return [_index_window(stack.grid, box_corners(low, high)) for stack in stacks]


def _index_window(grid: Grid, corners: Float[np.ndarray, "8 3"]) -> Window:
    index = grid.to_index(corners)
    first = np.clip(np.ceil(index.min(axis=0) - ROUNDING), 0, grid.shape).astype(int)
    end = np.clip(np.floor(index.max(axis=0) + ROUNDING) + 1, first, grid.shape).astype(int)
    return slice(first[0], end[0]), slice(first[1], end[1]), slice(first[2], end[2])


def _section_candidates(stack: MaskStack, plane: Plane, number: int, window: Window) -> _Candidates:
    """The section's voxels that were looked at, within the window."""
    first, second = (axis for axis in range(3) if axis != plane.axis)
    cut = (window[first], window[second])
    excluded = section_of(stack.excluded, plane)[cut]
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
    cover: float,
    rng: np.random.Generator,
) -> tuple[Int[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Rows that are used and the area (mm^2) that each stands for."""
    near = distance <= band
    near_rows, far_rows = np.flatnonzero(near), np.flatnonzero(~near)
    reserved = min(far_rows.size, int(COVER_SHARE * budget))
    near_count = min(near_rows.size, budget - reserved)
    allowed = max(COVER_LEAST, cover * near_count) if np.isfinite(cover) else far_rows.size
    far_count = int(min(budget - near_count, allowed))
    far_size = area[far_rows] / (1.0 + np.minimum(distance[far_rows], COVER_MARGIN_MM) / COVER_DECAY_MM)
    rows, weights = [], []
    for group, size, count in ((near_rows, area[near_rows], near_count), (far_rows, far_size, far_count)):
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
