"""Segmentation objects to mask stacks (PS3.3, A.51): binary, fractional and label map.

Frames that lie in parallel become one stack; a segmentation of planes in several directions becomes
several stacks. A label is a segment number. Planes without a frame were not looked at.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Shaped
from pydicom import Dataset
from pydicom.uid import UID, SegmentationStorage

from model.errors import InvalidMask, TooLarge
from model.geometry import Grid
from model.inference.mask_stack import MaskStack
from model.inference.plane_cover import cover_planes
from model.inference.stacks import EXCLUDED_VALUE, make_stack
from service.adapters.dicom.frame_planes import FramePlane, frame_planes
from service.adapters.dicom.objects import checked_frames, frames_of, tolerant
from service.adapters.dicom.plane_groups import parallel_groups
from service.adapters.dicom.planes import DrawnStack, drawn_stacks, stack_at_home
from service.adapters.image_guard import ImageLimits

#: SOP classes that are read here.
SEGMENTATIONS = (SegmentationStorage, UID("1.2.840.10008.5.1.4.1.1.66.7"))
#: Share of the largest value from which a voxel of a fractional segmentation belongs to the object.
OCCUPIED = 0.5
#: Voxels that are looked through for segments without any, at most.
MOST_SEARCHED = 1 << 27
#: Numbers listed in a message, at most.
LISTED_NUMBERS = 12


def read_segmentation(
    found: Dataset,
    part: str,
    limits: ImageLimits,
    labels: frozenset[int] | None = None,
    home: Grid | None = None,
) -> tuple[MaskStack, ...]:
    """The stacks of the object that the segments draw.

    Args:
        labels: segment numbers of the object; all segments when None.
        home: grid of the images that were drawn on; frames on them become planes of it.

    Raises:
        UnreadableImage, InvalidGeometry: damaged, or planes that are none.
        InvalidMask: nothing drawn, no such segment, or pixels of a segment that the object does not describe.
        TooLarge: over a limit.
    """
    count, rows, columns = checked_frames(found, part, limits)
    planes = frame_planes(found, part)
    if len(planes) != count:
        raise InvalidMask(f"{part} places {len(planes)} of its {count} frames; a place for each is needed", part=part)
    stacks = _stacks_of_frames(planes, columns, rows, home, part, limits)
    grids = [stack.grid for stack in stacks]
    require_room(grids, part, limits)
    seat = {
        frame: (number, place)
        for number, stack in enumerate(stacks)
        for frame, place in zip(stack.numbers.tolist(), stack.places.tolist(), strict=True)
    }
    volumes = [np.zeros(grid.shape, bool) for grid in grids]
    for frame, drawn in _drawings(found, part, labels):
        number, place = seat[frame]
        volumes[number][:, :, place] |= drawn.T
    return stacks_of(part, grids, volumes, [np.unique(stack.places) for stack in stacks])


def _stacks_of_frames(
    planes: Sequence[FramePlane], columns: int, rows: int, home: Grid | None, part: str, limits: ImageLimits
) -> list[DrawnStack]:
    """Stacks that hold each frame once; those of frames on the images are the images'."""
    groups = parallel_groups(planes, part)
    stacks = []
    for group in groups:
        chosen = [planes[number] for number in group]
        whole = stack_at_home(chosen, columns, rows, home, limits.max_voxels / len(groups))
        own = [whole] if whole else drawn_stacks(chosen, columns, rows, limits.max_voxels / len(groups))
        stacks += [replace(stack, numbers=np.array(group)[stack.numbers]) for stack in own]
    return stacks


def drawn_segments(found: Dataset, part: str) -> frozenset[int]:
    """Numbers of the segments that have a voxel; of a label map, all but the background.

    Frames are looked through until every segment was seen. In an object of more than `MOST_SEARCHED` voxels each
    segment that has a frame counts.
    """
    with tolerant(part):
        known = _numbers(found)
        framed = known if found.SegmentationType == "LABELMAP" else known & frozenset(_segments_of_frames(found))
    try:
        checked_frames(found, part, ImageLimits(max_bytes=MOST_SEARCHED, max_voxels=MOST_SEARCHED))
    except TooLarge:
        return framed
    drawn: frozenset[int] = frozenset()
    for numbers in _segments_in_frames(found, part):
        drawn |= numbers & framed
        if drawn == framed:
            break
    return drawn


def _segments_in_frames(found: Dataset, part: str) -> Iterator[frozenset[int]]:
    """Numbers of the segments that each frame has voxels of; of a label map, its values."""
    with tolerant(part):
        is_map, least = found.SegmentationType == "LABELMAP", _least_value(found)
        segments = [] if is_map else _segments_of_frames(found)
    if is_map:
        yield from map(_values_of, frames_of(found, part))
    for segment, frame in zip(segments, frames_of(found, part, range(len(segments))), strict=False):
        yield frozenset([segment] if (frame >= least).any() else [])


def listed(numbers: Iterable[int]) -> str:
    """Numbers for a message, the first of many."""
    every = sorted(numbers)
    rest = len(every) - LISTED_NUMBERS
    return ", ".join(map(str, every[:LISTED_NUMBERS])) + (f" and {rest} more" if rest > 0 else "")


def require_room(grids: Iterable[Grid], part: str, limits: ImageLimits) -> None:
    """Refuse stacks that together have more voxels than allowed: `TooLarge`."""
    if sum(float(np.prod([float(n) for n in grid.shape])) for grid in grids) > limits.max_voxels:
        raise TooLarge(f"{part} spans more than {limits.max_voxels} voxels, the most that is accepted", part=part)


def stacks_of(
    part: str,
    grids: Sequence[Grid],
    volumes: Sequence[Bool[np.ndarray, "i j k"]],
    drawn: Sequence[Shaped[np.ndarray, "n"]],
) -> tuple[MaskStack, ...]:
    """Checked stacks of those volumes that hold foreground.

    Where a drawing lies in planes of its stack, the others count as never looked at. A drawing across them, on
    planes along other axes, is left as it is.

    Raises:
        InvalidMask: nothing drawn at all.
    """
    kept = [(g, v, d) for g, v, d in zip(grids, volumes, drawn, strict=True) if v.any()]
    if not kept:
        raise InvalidMask(f"{part} draws nothing; an object with at least one voxel of it is accepted", part=part)
    return tuple(make_stack(part, _values(volume, planes), grid.affine) for grid, volume, planes in kept)


def _values(volume: Bool[np.ndarray, "i j k"], drawn: Shaped[np.ndarray, "n"]) -> Shaped[np.ndarray, "i j k"]:
    values = volume.astype(np.uint8)
    if all(axis == 2 for axis, _ in cover_planes(volume)):
        values[:, :, np.setdiff1d(np.arange(volume.shape[2]), drawn)] = EXCLUDED_VALUE
    return values


def _drawings(
    found: Dataset, part: str, labels: frozenset[int] | None
) -> Iterator[tuple[int, Bool[np.ndarray, "rows columns"]]]:
    """Numbers of the frames that may show the object, and which of their pixels are of it."""
    with tolerant(part):
        is_map, least = found.SegmentationType == "LABELMAP", _least_value(found)
        known, ground = _numbers(found), _background(found)
        segments = [] if is_map else _segments_of_frames(found)
    if labels is not None and not labels <= known:
        raise InvalidMask(
            f"{part} has no segment {listed(labels - known)}; segments that are there: {listed(known) or 'none'}",
            part=part,
        )
    _require_described(frozenset(segments), known, part)
    wanted = known & (labels or known)
    if not is_map:
        chosen = [number for number, segment in enumerate(segments) if segment in wanted]
        for number, frame in zip(chosen, frames_of(found, part, chosen), strict=True):
            yield number, frame >= least
        return
    for number, frame in enumerate(frames_of(found, part)):
        _require_described(_values_of(frame) - {ground}, known, part)
        yield number, np.isin(frame, sorted(wanted))


def _least_value(found: Dataset) -> float:
    """Stored value from which a voxel of a segment's frame belongs to it. Call within `tolerant`."""
    most = float(found.get("MaximumFractionalValue") or 1)
    return OCCUPIED * most if found.SegmentationType == "FRACTIONAL" else OCCUPIED


def _values_of(frame: Shaped[np.ndarray, "rows columns"]) -> frozenset[int]:
    """Distinct values of a frame; those of few bits are counted, which is faster than to sort them."""
    if frame.dtype.kind == "u" and frame.dtype.itemsize <= 2:
        return frozenset(np.flatnonzero(np.bincount(frame.ravel())).tolist())
    return frozenset(np.unique(frame).tolist())


def _require_described(drawn: frozenset[int], known: frozenset[int], part: str) -> None:
    if not drawn <= known:
        raise InvalidMask(
            f"{part} draws segment {listed(drawn - known)}, which it does not describe; "
            f"segments that are there: {listed(known) or 'none'}",
            part=part,
        )


def _numbers(found: Dataset) -> frozenset[int]:
    """Segment numbers of the object; the background of a label map is none. Call within `tolerant`."""
    numbers = frozenset(int(segment.SegmentNumber) for segment in found.SegmentSequence)
    return numbers - {_background(found)} if found.SegmentationType == "LABELMAP" else numbers


def _background(found: Dataset) -> int:
    """What a label map holds where there is no segment."""
    return int(found.get("PixelPaddingValue") or 0)


def _segments_of_frames(found: Dataset) -> list[int]:
    shared = (found.get("SharedFunctionalGroupsSequence") or [Dataset()])[0]
    name = "SegmentIdentificationSequence"
    return [
        int((frame if name in frame else shared)[name][0].ReferencedSegmentNumber)
        for frame in found.PerFrameFunctionalGroupsSequence
    ]
