"""Drawings as they come in practice, made from dense masks: noisy, cut off, oblique, incomplete, moved, partly wrong.

Each drawn plane is a stack of its own, one voxel thick, so that planes that cross may contradict each other. All
functions are pure; those that need chance take a generator.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt, gaussian_filter, shift
from scipy.spatial.transform import Rotation

from model.geometry import Grid
from model.inference.mask_stack import MaskStack, Plane, section_of
from training.cohorts.cohort import Case
from training.oblique import random_planes, section
from training.placing import inner_points
from training.sparsify import Drawing, body_axes

WrongKind = Literal["shifted", "another case", "mirrored", "dilated", "misplaced"]
WRONG_KINDS: tuple[WrongKind, ...] = ("shifted", "another case", "mirrored", "dilated", "misplaced")
#: A shifted slice lies this far off (mm), and a dilated one is this much too large.
SHIFT_MM, DILATION_MM = (8.0, 10.0), 3.0
#: A misplaced slice shows what belongs this many drawn slices further on.
MISPLACED_SLOTS = 2
#: Background around each section, so that what is shifted or dilated keeps its place (mm).
ROOM_MM = 15.0
#: An annotator's deviation along the contour: SD and correlation length (mm).
NOISE_SD_MM, NOISE_LENGTH_MM = 1.0, 5.0


@dataclass(frozen=True)
class Sections:
    """Drawn planes, each a stack of one voxel plane.

    Attributes:
        stacks: in the order of the drawing; background is background, what lies off the grid is unknown.
        axes: index axis across each stack's plane.
    """

    stacks: tuple[MaskStack, ...]
    axes: tuple[int, ...]

    @property
    def planes(self) -> tuple[Plane, ...]:
        """The planes as inference names them."""
        return tuple(Plane(number, axis, 0) for number, axis in enumerate(self.axes))

    def labels(self, number: int) -> Bool[np.ndarray, "a b"]:
        """What was drawn on a plane."""
        return section_of(self.stacks[number].foreground, self.planes[number])

    def spacing(self, number: int) -> Float[np.ndarray, "2"]:
        """In-plane spacing of a plane (mm)."""
        return np.asarray(np.delete(self.stacks[number].grid.spacing, self.axes[number]))

    def redrawn(self, number: int, labels: Bool[np.ndarray, "a b"]) -> "Sections":
        """The same with other labels on one plane."""
        stacks = list(self.stacks)
        stacks[number] = replace(stacks[number], foreground=np.expand_dims(labels, self.axes[number]))
        return replace(self, stacks=tuple(stacks))

    def only(self, numbers: Sequence[int]) -> "Sections":
        """Some of the planes."""
        return Sections(tuple(self.stacks[n] for n in numbers), tuple(self.axes[n] for n in numbers))


def sections_of(drawing: Drawing, room_mm: float = ROOM_MM) -> Sections:
    """The planes of a drawing, apart, each with room around it."""
    grid, axes = drawing.stack.grid, tuple(plane.axis for plane in drawing.planes)
    stacks = []
    for number, plane in enumerate(drawing.planes):
        room = np.ceil(room_mm / grid.spacing).astype(int)
        room[plane.axis] = 0
        labels = np.expand_dims(section_of(drawing.stack.foreground, plane), plane.axis)
        labels = np.pad(labels, [(width, width) for width in room])
        corner = -room.astype(float)
        corner[plane.axis] = plane.index
        stacks.append(_stack(number, labels, grid, corner))
    return Sections(tuple(stacks), axes)


def _stack(number: int, labels: Bool[np.ndarray, "i j k"], grid: Grid, corner: Float[np.ndarray, "3"]) -> MaskStack:
    """A stack whose first voxel stands at an index of another grid."""
    affine = grid.affine.astype(float).copy()
    affine[:3, 3] = grid.to_world(corner[None])[0]
    first, second, third = labels.shape
    return MaskStack(f"mask[{number}]", Grid((first, second, third), affine), labels, np.zeros_like(labels))


def parallel(mask: Bool[np.ndarray, "i j k"], grid: Grid, count: int = 5) -> Sections:
    """Slices across the object's longest body axis, with equal gaps between them and to its ends.

    Where it has fewer slices than that, each is drawn once.
    """
    axis, first, last = _longest(mask, grid)
    places = first + (np.arange(count) + 0.5) * (last + 1 - first) / count
    return sections_of(_drawing(mask, grid, axis, sorted({int(place) for place in places})))


def one_end(mask: Bool[np.ndarray, "i j k"], grid: Grid, every: int = 3) -> Sections:
    """Every third slice of the first third of the object along its longest body axis."""
    axis, first, last = _longest(mask, grid)
    end = first + max(every + 1, (last + 1 - first) // 3)
    return sections_of(_drawing(mask, grid, axis, list(range(first, end, every))))


def oblique(case: Case, count: int, seed: int = 0) -> Sections:
    """Random planes in any orientation, each a series of its own."""
    return Sections(random_planes(case, count, seed).stacks, (2,) * count)


def tilted(case: Case, degrees: float, count: int = 5) -> Sections:
    """Parallel slices as of `parallel` whose normal leans by an angle."""
    axis, _, _ = _longest(case.mask, case.grid)
    along = case.grid.affine[:3, axis] / case.grid.spacing[axis]
    about = case.grid.affine[:3, (axis + 1) % 3]
    normal = Rotation.from_rotvec(np.radians(degrees) * about / np.linalg.norm(about)).apply(along)
    reach = inner_points(case.mask, case.grid) @ normal
    places = reach.min() + (np.arange(count) + 0.5) * np.ptp(reach) / count
    stacks = tuple(section(case, normal, float(place), f"mask[{n}]") for n, place in enumerate(places))
    return Sections(stacks, (2,) * count)


def noisy(
    sections: Sections, rng: np.random.Generator, sd_mm: float = NOISE_SD_MM, length_mm: float = NOISE_LENGTH_MM
) -> Sections:
    """Contours moved in and out by a smooth Gaussian random function (squared exponential)."""
    for number in range(len(sections.stacks)):
        labels, spacing = sections.labels(number), sections.spacing(number)
        field = gaussian_filter(rng.standard_normal(labels.shape), length_mm / np.sqrt(2.0) / spacing, mode="wrap")
        moved = _signed_distance(labels, spacing) + sd_mm * field / max(float(field.std()), 1e-12)
        if labels.any() and (moved > 0).any():
            sections = sections.redrawn(number, np.asarray(moved > 0))
    return sections


def cut_off(sections: Sections, share: float = 0.25) -> Sections:
    """Grids that end inside the object: contours are open there, and what lies beyond is unknown.

    The share of the object's world extent at its far end is lost, along the first in-plane axis of each plane.
    """
    stacks = []
    for stack, axis in zip(sections.stacks, sections.axes, strict=True):
        along = 1 if axis == 0 else 0
        held = np.flatnonzero(stack.foreground.any(axis=tuple(a for a in range(3) if a != along)))
        size = stack.grid.shape[along]
        end = int(held[-1] + 1 - round(share * len(held))) if held.size else size
        cut = [slice(None)] * 3
        cut[along] = slice(0, end)
        labels, excluded = stack.foreground[tuple(cut)], stack.excluded[tuple(cut)]
        shape = labels.shape
        grid = Grid((shape[0], shape[1], shape[2]), stack.grid.affine)
        stacks.append(MaskStack(stack.part, grid, labels, excluded))
    return replace(sections, stacks=tuple(stacks))


def moved(sections: Sections, affine: Float[np.ndarray, "4 4"]) -> Sections:
    """The same drawing elsewhere in the world (RAS mm)."""
    stacks = tuple(replace(stack, grid=Grid(stack.grid.shape, affine @ stack.grid.affine)) for stack in sections.stacks)
    return replace(sections, stacks=stacks)


def with_wrong(sections: Sections, number: int, kind: WrongKind, rng: np.random.Generator, other: Sections) -> Sections:
    """One plane drawn wrong.

    Args:
        number: which plane.
        kind: shifted within its plane, a section of another case, mirrored in its plane about its own centre,
            dilated, or what belongs two drawn slices further on.
        other: the same slices of another case, for ``another case``.
    """
    labels, spacing = sections.labels(number), sections.spacing(number)
    match kind:
        case "shifted":
            angle, length = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*SHIFT_MM)
            wrong = _shifted(labels, length * np.array([np.cos(angle), np.sin(angle)]) / spacing)
        case "another case":
            wrong = _placed_like(other.labels(number), labels)
        case "mirrored":
            wrong = _placed_like(labels[::-1], labels)
        case "dilated":
            wrong = _signed_distance(labels, spacing) > -DILATION_MM
        case "misplaced":
            count = len(sections.stacks)
            source = number + MISPLACED_SLOTS if number + MISPLACED_SLOTS < count else number - MISPLACED_SLOTS
            wrong = sections.labels(source)
        case never:
            assert_never(never)
    return sections.redrawn(number, np.asarray(wrong, dtype=bool))


def _drawing(mask: Bool[np.ndarray, "i j k"], grid: Grid, axis: int, indices: Sequence[int]) -> Drawing:
    stack = MaskStack("mask[0]", grid, mask, np.zeros_like(mask))
    return Drawing(stack, tuple(Plane(0, axis, index) for index in indices))


def _longest(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> tuple[int, int, int]:
    """The axis along which the object is longest (mm), and the first and last index that hold some of it."""
    index = np.argwhere(mask)
    low, high = index.min(axis=0), index.max(axis=0)
    extent = (high - low + 1) * grid.spacing
    axis = max(body_axes(grid), key=lambda a: float(extent[a]))
    return axis, int(low[axis]), int(high[axis])


def _signed_distance(labels: Bool[np.ndarray, "*s"], spacing: Float[np.ndarray, "n"]) -> Float[np.ndarray, "*s"]:
    """Distance (mm) to the border between the voxels, positive inside."""
    half = float(spacing.min()) / 2.0
    inside = distance_transform_edt(labels, spacing) if labels.any() else np.zeros(labels.shape)
    outside = distance_transform_edt(~labels, spacing) if labels.any() else np.full(labels.shape, np.inf)
    return np.where(labels, inside - half, half - outside)


def _shifted(labels: Bool[np.ndarray, "a b"], voxels: Float[np.ndarray, "2"]) -> Bool[np.ndarray, "a b"]:
    return np.asarray(shift(labels.astype(float), voxels, order=1, mode="constant") > 0.5)


def _placed_like(drawn: Bool[np.ndarray, "c d"], like: Bool[np.ndarray, "a b"]) -> Bool[np.ndarray, "a b"]:
    """A drawing on another's grid of voxels, with its centre in the same place."""
    result = np.zeros(like.shape, dtype=bool)
    index = np.argwhere(drawn)
    if not index.size:
        return result
    place = np.rint(index - index.mean(axis=0) + np.argwhere(like).mean(axis=0)).astype(int)
    place = place[((place >= 0) & (place < like.shape)).all(axis=1)]
    result[tuple(place.T)] = True
    return result
