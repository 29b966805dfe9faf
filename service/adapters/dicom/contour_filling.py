"""Pixels that the contours of one plane enclose.

Each contour is filled by the even-odd rule, so that a keyhole's channel, which is run through twice, encloses
nothing. Contours of one region and plane are put together as their type says:

- CLOSEDPLANAR_XOR: what an odd number of them encloses.
- CLOSED_PLANAR: contours that overlap in part are united. One inside another takes away, as nearly all who write
  such contours mean it, and one inside that adds again.

A contour that comes twice counts once. One that encloses no pixel's centre stands for the pixel at its middle.
"""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from model.errors import InvalidGeometry
from model.geometry import Grid
from service.adapters.dicom.contours import FLATNESS_MM, Contour, ras
from service.adapters.dicom.scan_lines import enclosed

#: Digits (of mm) in which contours agree that are the same.
SAME_DIGITS = 3
#: Share of a contour's area that one inside it has at least when it is the same, rounded otherwise.
SAME_AREA = 0.9


def filled(sheet: Sequence[Contour], grid: Grid, part: str) -> Bool[np.ndarray, "i j"]:
    """Pixels that the contours of one plane, the largest first, enclose: those of any region."""
    regions: dict[int, dict[bytes, Contour]] = defaultdict(dict)
    for contour in sheet:
        regions[contour.region].setdefault(_identity(contour), contour)
    inside = np.zeros(grid.shape[:2], bool)
    for contours in regions.values():
        inside |= _filled_region(list(contours.values()), grid, part)
    return inside


def _identity(contour: Contour) -> bytes:
    """The same for contours of the same points, wherever they begin and whichever way they run."""
    return np.unique(np.round(contour.points, SAME_DIGITS) + 0.0, axis=0).tobytes()


def _filled_region(contours: Sequence[Contour], grid: Grid, part: str) -> Bool[np.ndarray, "i j"]:
    nest = _Nest(grid.shape[:2])
    crossed = np.zeros(grid.shape[:2], bool)
    specks = []
    for contour in contours:
        mask = _enclosed(contour, grid)
        if not mask.any():
            specks.append(_pixel_of(contour, grid, part))
        elif contour.is_xor:
            crossed ^= mask
        else:
            nest.add(contour, mask)
    inside = nest.filled ^ crossed
    for column, row in specks:
        inside[column, row] = True
    return inside


def _enclosed(contour: Contour, grid: Grid) -> Bool[np.ndarray, "i j"]:
    return enclosed(grid.to_index(ras(contour.points))[:, :2], grid.shape[:2])


def _pixel_of(contour: Contour, grid: Grid, part: str) -> tuple[int, int]:
    """The pixel at the middle of a contour that encloses no pixel's centre."""
    column, row = (round(i) for i in grid.to_index(ras(contour.middle[None]))[0, :2].tolist())
    if not (0 <= column < grid.shape[0] and 0 <= row < grid.shape[1]):
        raise InvalidGeometry(
            f"{part} has a contour of region {contour.region} beside the images; contours on them are accepted",
            part=part,
        )
    return column, row


class _Nest:
    """Plain contours of one region and plane, painted from the largest on: those inside others take away or add."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.filled = np.zeros(shape, bool)
        self._innermost = np.full(shape, -1)
        self._contours: list[Contour] = []
        self._pixels: list[int] = []
        self._holders: list[int] = []
        self._levels: list[int] = []

    def add(self, contour: Contour, mask: Bool[np.ndarray, "i j"]) -> None:
        """Paint a contour that is not larger than those before, and the pixels that it encloses."""
        holder, pixels = self._holder_of(mask), int(mask.sum())
        if holder >= 0 and (pixels == self._pixels[holder] or _is_same(contour, self._contours[holder])):
            return
        level = self._levels[holder] + 1 if holder >= 0 else 0
        self.filled[mask] = level % 2 == 0
        self._innermost[mask] = len(self._contours)
        self._contours.append(contour)
        self._pixels.append(pixels)
        self._holders.append(holder)
        self._levels.append(level)

    def _holder_of(self, mask: Bool[np.ndarray, "i j"]) -> int:
        """The innermost contour that holds all that the pixels lie in, or is that itself; -1 when none does.

        Whoever holds a contour has a lower number, so the highest gives way to its holder until one is left.
        """
        held = set(np.unique(self._innermost[mask]).tolist())
        while len(held) > 1:
            highest = max(held)
            held.remove(highest)
            held.add(-1 if -1 in held else self._holders[highest])
        return int(held.pop())


def _is_same(inner: Contour, outer: Contour) -> bool:
    """Whether a contour inside another is that one, written with other digits."""
    apart = np.abs(inner.points.min(axis=0) - outer.points.min(axis=0))
    apart = np.maximum(apart, np.abs(inner.points.max(axis=0) - outer.points.max(axis=0)))
    return bool(apart.max() <= FLATNESS_MM) and inner.area >= SAME_AREA * outer.area
