"""Which of many planes belong together: parallel ones, and those that can be one stack."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from model.errors import TooLarge
from service.adapters.dicom.frame_planes import PARALLEL, FramePlane

#: Share of a pixel or of the step by which planes may lie off their place in a stack, as rounded positions do.
REGULAR_SHARE = 0.05
#: Share by which the pixels of planes of one stack may differ in size.
SAME_PIXELS = 1e-3
#: Directions and places of which the planes of a drawing may be, at most.
MOST_GROUPS = 512

#: Whether each of some numbered things is like one of them.
Alike = Callable[[int, Int[np.ndarray, "n"]], Bool[np.ndarray, "n"]]


def parallel_groups(planes: Sequence[FramePlane], part: str) -> list[list[int]]:
    """Numbers of the planes that can be one stack: parallel, of one spacing, in register.

    Raises:
        TooLarge: more than `MOST_GROUPS` stacks.
    """
    axes, spacings = _axes(planes), np.array([plane.spacing for plane in planes])
    origins = np.array([plane.origin for plane in planes])

    def in_register(first: int, others: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
        shift = np.abs((origins[others] - origins[first]) @ axes[first].T) / spacings[first]
        return np.asarray(_alike(axes, spacings, first)[others] & (shift.max(axis=1) <= REGULAR_SHARE))

    return in_groups(len(planes), in_register, part)


def in_groups(count: int, alike: Alike, part: str) -> list[list[int]]:
    """Numbers from 0 on, each in the first group whose first number it is like.

    Raises:
        TooLarge: more than `MOST_GROUPS` groups.
    """
    groups: list[list[int]] = []
    rest = np.arange(count)
    while len(rest):
        if len(groups) == MOST_GROUPS:
            raise TooLarge(
                f"{part} draws on planes of more than {MOST_GROUPS} directions or places, the most that are accepted; "
                "planes of few stacks are",
                part=part,
            )
        same = alike(int(rest[0]), rest)
        same[0] = True
        groups.append(rest[same].tolist())
        rest = rest[~same]
    return groups


def unlike_the_first(planes: Sequence[FramePlane]) -> list[int]:
    """Numbers of the planes that differ from the first in their direction or the size of their pixels."""
    spacings = np.array([plane.spacing for plane in planes])
    return np.flatnonzero(~_alike(_axes(planes), spacings, 0)).tolist()


def _axes(planes: Sequence[FramePlane]) -> Float[np.ndarray, "n 2 3"]:
    return np.array([[plane.row, plane.column] for plane in planes])


def _alike(axes: Float[np.ndarray, "n 2 3"], spacings: Float[np.ndarray, "n 2"], first: int) -> Bool[np.ndarray, "n"]:
    turned = np.abs(axes - axes[first]).max(axis=(1, 2))
    return np.asarray((turned <= PARALLEL) & np.isclose(spacings[first], spacings, rtol=SAME_PIXELS).all(axis=1))
