"""Which planes of a sparse volume were drawn: the fewest that together hold all foreground.

Seen from the foreground alone this is a set cover with one twist. A plane that nobody drew still holds
foreground wherever it crosses planes that were drawn, as lines one voxel wide. So a voxel *supports* a
plane only when it belongs to a 2 x 2 block of foreground within it: a section of a solid has such blocks,
a crossing has none. Planes are chosen greedily (Chvatal 1979) by the supporting voxels that they add,
and those that the rest makes needless are taken out again. Ties go to the last axis.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from model.inference.mask_stack import occupied

#: (axis, index) of a plane of voxels.
AxisPlane = tuple[int, int]
#: A volume is solid when at least this share of its foreground lies in 2 x 2 x 2 blocks.
SOLID_SHARE = 0.5
#: A solid is cut along one axis unless planes along several are fewer than this share of those.
MIXED_SHARE = 0.5


def cover_planes(foreground: Bool[np.ndarray, "i j k"]) -> list[AxisPlane]:
    """The fewest planes, along any axis, that together hold all foreground.

    Solid volumes (dense masks) are cut along the axis with the fewest planes; sparse ones into the planes
    that their foreground supports.

    Returns:
        planes in ascending order; empty without foreground.
    """
    held = [occupied(foreground, axis) for axis in range(3)]
    if not held[0].size:
        return []
    corner = [int(h[0]) for h in held]
    box = foreground[tuple(slice(h[0], h[-1] + 1) for h in held)]
    return sorted((axis, index + corner[axis]) for axis, index in _cover_box(box))


def _cover_box(box: Bool[np.ndarray, "i j k"]) -> list[AxisPlane]:
    if not _is_solid(box):
        return _mixed_cover(box, limit=sum(box.shape))
    axis = min(range(3), key=lambda a: (len(occupied(box, a)), -a))
    single = [(axis, int(index)) for index in occupied(box, axis)]
    limit = int(MIXED_SHARE * len(single))
    mixed = _mixed_cover(box, limit) if limit > 1 else []
    return mixed if 0 < len(mixed) < limit else single


def _others(axis: int) -> tuple[int, int]:
    first, second = (a for a in range(3) if a != axis)
    return first, second


def _is_solid(box: Bool[np.ndarray, "i j k"]) -> bool:
    blocks = _in_blocks(box, (0, 1, 2))
    return bool(np.count_nonzero(blocks) >= SOLID_SHARE * np.count_nonzero(box))


def _in_blocks(volume: Bool[np.ndarray, "i j k"], axes: tuple[int, ...]) -> Bool[np.ndarray, "i j k"]:
    """Voxels that lie in a block of foreground two voxels wide along each of the axes (an opening)."""
    opened = volume
    for axis in axes:
        opened = _shifted(opened, axis, -1) & opened
    for axis in axes:
        opened = _shifted(opened, axis, 1) | opened
    return opened


def _shifted(volume: Bool[np.ndarray, "i j k"], axis: int, step: int) -> Bool[np.ndarray, "i j k"]:
    """``out[n] = volume[n - step]`` along the axis, False outside."""
    moved = np.zeros_like(volume)
    target, source = np.moveaxis(moved, axis, 0), np.moveaxis(volume, axis, 0)
    if step > 0:
        target[step:] = source[:-step]
    else:
        target[:step] = source[-step:]
    return moved


@dataclass(frozen=True)
class _Progress:
    """State of the greedy cover.

    Attributes:
        left: voxels not yet held by a chosen plane.
        counts: of each axis, how many of them each plane would add.
        support: of each axis, the voxels that count towards its planes.
        chosen: planes so far.
    """

    left: Bool[np.ndarray, "i j k"]
    counts: tuple[Int[np.ndarray, "_"], ...]
    support: tuple[Bool[np.ndarray, "i j k"], ...]
    chosen: list[AxisPlane]

    def choose(self, plane: AxisPlane) -> None:
        """Take a plane; its voxels stop counting for all planes that cross it."""
        axis, index = plane
        cut = [slice(None)] * 3
        cut[axis] = slice(index, index + 1)
        slab = self.left[tuple(cut)]
        for a in range(3):
            gone = (slab & self.support[a][tuple(cut)]).sum(axis=_others(a))
            self.counts[a][index if a == axis else slice(None)] -= gone[0] if a == axis else gone
        slab[...] = False
        self.chosen.append(plane)


def _begin(
    left: Bool[np.ndarray, "i j k"], support: tuple[Bool[np.ndarray, "i j k"], ...], chosen: list[AxisPlane]
) -> _Progress:
    counts = tuple((left & support[axis]).sum(axis=_others(axis)) for axis in range(3))
    return _Progress(left, counts, support, chosen)


def _mixed_cover(box: Bool[np.ndarray, "i j k"], limit: int) -> list[AxisPlane]:
    """Planes along any axes; given up (empty) when more than the limit are needed."""
    blocks = tuple(_in_blocks(box, _others(axis)) for axis in range(3))
    progress = _begin(box.copy(), blocks, [])
    while max(counts.max() for counts in progress.counts) > 0:
        if len(progress.chosen) >= limit:
            return []
        progress.choose(_fullest(progress.counts))
    _add_specks(box, progress)
    return _without_needless(box, progress.chosen) if len(progress.chosen) <= limit else []


def _fullest(counts: tuple[Int[np.ndarray, "_"], ...]) -> AxisPlane:
    axis = max(range(3), key=lambda a: (counts[a].max(), a))
    return axis, int(np.argmax(counts[axis]))


def _add_specks(box: Bool[np.ndarray, "i j k"], progress: _Progress) -> None:
    """Planes for foreground without any 2 x 2 block, such as the tip of a shape.

    The plane whose foreground consists of such voxels most is the likeliest to have been drawn: any
    other would claim that the lines in which it crosses drawn planes are a section. Then the plane that
    holds more of them, then the axis that most planes have.
    """
    everywhere = (np.ones_like(box),) * 3
    specks = _begin(progress.left, everywhere, progress.chosen)
    totals = [np.maximum(box.sum(axis=_others(axis)), 1) for axis in range(3)]
    while specks.counts[0].any():
        used = [axis for axis, _ in specks.chosen]
        options = [
            (float(specks.counts[a][i] / totals[a][i]), int(specks.counts[a][i]), used.count(a), a, -int(i))
            for a in range(3)
            for i in np.flatnonzero(specks.counts[a])
        ]
        *_, axis, negative = max(options)
        specks.choose((axis, -negative))


def _without_needless(box: Bool[np.ndarray, "i j k"], planes: list[AxisPlane]) -> list[AxisPlane]:
    """The planes less those whose foreground other planes hold already, smallest first."""
    times = np.zeros(box.shape, dtype=np.int8)
    for axis, index in planes:
        np.moveaxis(times, axis, 0)[index] += 1
    kept = []
    for axis, index in sorted(planes, key=lambda p: (np.moveaxis(box, p[0], 0)[p[1]].sum(), p)):
        held = np.moveaxis(times, axis, 0)[index]
        if held[np.moveaxis(box, axis, 0)[index]].min() >= 2:
            held -= 1
        else:
            kept.append((axis, index))
    return kept
