"""Which planes of the stacks were looked at: by a rule of the interface, or by name."""

from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from typing import Literal

import numpy as np
from jaxtyping import Float

from model.errors import InconsistentStacks, InvalidMask, InvalidParameter
from model.geometry import Grid
from model.inference.mask_stack import MaskStack, Plane, index_box, occupied, section_of, world_box
from model.inference.plane_cover import cover_planes
from model.inference.repeats import each_place_once, looked_at
from model.inference.stacks import EXCLUDED_VALUE

AnnotatedRule = Literal["auto", "all", "nonempty"]

#: Boxes around the foreground of two stacks may lie this far apart (mm) where nothing is known of the object's size.
WORLD_GAP_MM = 200.0
#: Spacings that differ by less than this share are equal.
SPACING_TOLERANCE = 1e-3


def find_planes(
    stacks: Sequence[MaskStack], rule: AnnotatedRule | Sequence[Plane], gap_mm: float = WORLD_GAP_MM
) -> tuple[Plane, ...]:
    """The annotated planes by a rule of the interface, or those named, checked against the stacks.

    ``all`` takes every plane along the axis of the largest spacing, ``nonempty`` those of them that hold
    foreground, ``auto`` the fewest planes along any axes that together hold all foreground
    (`model.inference.plane_cover`). A stack of a single slice has that one alone. Each stack is judged by itself.
    Where a plane of one stack shows the place of another's, the first one counts (`repeat_warnings`): a drawing that
    is sent twice knows no more than one. At least two planes have to show different places (`lie_apart`).
    Planes without foreground are annotated by ``all`` and by name only: between two drawn slices of a
    sparse stack nobody has looked.

    Args:
        gap_mm: how far from all others the foreground of a stack may lie: two ends of one object can be a whole
            object apart.

    Returns:
        the planes in ascending order, each once.

    Raises:
        InvalidMask: fewer than two planes, or no foreground on them.
        InvalidParameter: a named plane that its stack does not have or that was never looked at, or fewer than two
            named.
        InconsistentStacks: the foreground of some stacks over `gap_mm` from that of all others.
    """
    return planes_and_repeats(stacks, rule, gap_mm)[0]


def planes_and_repeats(
    stacks: Sequence[MaskStack], rule: AnnotatedRule | Sequence[Plane], gap_mm: float = WORLD_GAP_MM
) -> tuple[tuple[Plane, ...], tuple[Plane, ...]]:
    """What `find_planes` finds, and the planes that do not count because an earlier stack shows their places."""
    _check_same_world(stacks, gap_mm)
    planes, again = each_place_once(stacks, _all_planes(stacks, rule))
    if not any(section_of(stacks[p.stack].foreground, p).any() for p in planes):
        raise InvalidMask("mask holds no foreground on its annotated planes; at least one voxel is needed", part="mask")
    return planes, again


def repeat_warnings(stacks: Sequence[MaskStack], again: Sequence[Plane]) -> tuple[str, ...]:
    """What to tell about the second planes of `planes_and_repeats`."""
    return tuple(
        f"{stacks[number].part} shows {count} plane(s) that an earlier mask shows too; the first drawing of a place "
        "counts."
        for number, count in sorted(Counter(plane.stack for plane in again).items())
    )


def _all_planes(stacks: Sequence[MaskStack], rule: AnnotatedRule | Sequence[Plane]) -> tuple[Plane, ...]:
    if not isinstance(rule, str):
        return _named_planes(stacks, rule)
    planes = tuple(
        Plane(number, axis, index)
        for number, stack in enumerate(stacks)
        for axis, index in sorted(_planes_by_rule(stack, rule))
    )
    _check_count(stacks, planes)
    return planes


def _planes_by_rule(stack: MaskStack, rule: AnnotatedRule) -> list[tuple[int, int]]:
    flat = [axis for axis, size in enumerate(stack.grid.shape) if size == 1]
    if len(flat) == 1:
        return [(flat[0], 0)]
    drawn = stack.foreground & ~stack.excluded
    if rule == "auto":
        return cover_planes(drawn)
    thick = _thickest_axes(stack.grid)
    held = {axis: occupied(drawn, axis) for axis in thick}
    if rule == "nonempty":
        axis = min(thick, key=lambda a: (len(held[a]), -a))
        return [(axis, int(index)) for index in held[axis]]
    auto_axes = [a for a, _ in cover_planes(drawn)] if len(thick) > 1 else []
    axis = max(thick, key=lambda a: (auto_axes.count(a), a))
    return [(axis, int(index)) for index in occupied(~stack.excluded, axis)]


def _thickest_axes(grid: Grid) -> list[int]:
    spacing = grid.spacing
    return [axis for axis in range(3) if spacing[axis] >= spacing.max() * (1.0 - SPACING_TOLERANCE)]


def _check_count(stacks: Sequence[MaskStack], planes: tuple[Plane, ...]) -> None:
    if not lie_apart(stacks, planes):
        part = stacks[0].part if len(stacks) == 1 else "mask"
        found = "one slice only" if planes else "no annotated plane"
        raise InvalidMask(
            f"{part} holds {found}; at least two annotated planes in different places are needed", part=part
        )


def lie_apart(stacks: Sequence[MaskStack], planes: Sequence[Plane]) -> bool:
    """Whether two of the planes show different places, in one stack or in two.

    A plane shows no more than another one if all that was looked at on it lies within half a slice spacing of the
    other: the same slice of a second stack, or a row of voxels of a single slice.
    """
    return any(not _shows_no_more(stacks, *pair) for pair in combinations(planes, 2))


def _shows_no_more(stacks: Sequence[MaskStack], first: Plane, second: Plane) -> bool:
    spacing = min(stacks[plane.stack].grid.spacing[plane.axis] for plane in (first, second))
    nearest = min(_farthest_mm(stacks, first, second), _farthest_mm(stacks, second, first))
    return bool(nearest < spacing / 2)


def _farthest_mm(stacks: Sequence[MaskStack], shown: Plane, other: Plane) -> float:
    """How far what was looked at on a plane reaches from another plane."""
    grid = stacks[other.stack].grid
    index = grid.to_index(looked_at(stacks[shown.stack], shown))[:, other.axis]
    return float(np.abs(index - other.index).max() * grid.spacing[other.axis])


def check_stacks(named: Sequence[Plane], count: int) -> None:
    """Refuse planes of stacks that are not among so many.

    Raises:
        InvalidParameter: names the first such plane.
    """
    for position, plane in enumerate(named):
        if not 0 <= plane.stack < count:
            part = f"annotated[{position}]"
            raise InvalidParameter(f"{part} names stack {plane.stack}; 0 to {count - 1} is accepted", part=part)


def _named_planes(stacks: Sequence[MaskStack], named: Sequence[Plane]) -> tuple[Plane, ...]:
    check_stacks(named, len(stacks))
    positions: dict[Plane, int] = {}
    for position, plane in enumerate(named):
        positions.setdefault(plane, position)
    for plane, position in positions.items():
        _check_plane(stacks[plane.stack], plane, f"annotated[{position}]")
    planes = tuple(sorted(positions))
    if not lie_apart(stacks, planes):
        raise InvalidParameter(
            "annotated names one slice only; at least two planes in different places are needed", part="annotated"
        )
    return planes


def _check_plane(stack: MaskStack, plane: Plane, part: str) -> None:
    if not 0 <= plane.axis < 3:
        raise InvalidParameter(f"{part} names axis {plane.axis}; 0 to 2 is accepted", part=part)
    size = stack.grid.shape[plane.axis]
    if not 0 <= plane.index < size:
        raise InvalidParameter(
            f"{part} names plane {plane.index} along axis {plane.axis} of {stack.part}; 0 to {size - 1} is accepted",
            part=part,
        )
    if section_of(stack.excluded, plane).all():
        raise InvalidParameter(
            f"{part} names a plane that was never looked at: it holds {EXCLUDED_VALUE} only; "
            "a plane with any other value is accepted",
            part=part,
        )


def _check_same_world(stacks: Sequence[MaskStack], gap_mm: float) -> None:
    """Every stack must be near another, and through such neighbours near all: many series may hold a slice each."""
    boxes = [world_box(stack.grid, *index_box(stack.foreground)) for stack in stacks]
    nearest = {number: (_gap(boxes[0], boxes[number]), 0) for number in range(1, len(stacks))}
    while nearest:
        second = min(nearest, key=lambda number: (*nearest[number], number))
        gap, first = nearest.pop(second)
        if gap > gap_mm:
            raise InconsistentStacks(
                f"{stacks[first].part} and {stacks[second].part} lie {gap:.0f} mm apart in the world, too far for one "
                "object; stacks of one object in one frame are accepted",
                part=stacks[second].part,
            )
        for number, known in nearest.items():
            nearest[number] = min(known, (_gap(boxes[second], boxes[number]), second))


def _gap(
    first: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]],
    second: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]],
) -> float:
    """Largest distance (mm) between two boxes along any axis, negative where they overlap along all."""
    return float((np.maximum(first[0], second[0]) - np.minimum(first[1], second[1])).max())
