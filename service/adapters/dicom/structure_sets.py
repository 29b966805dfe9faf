"""RT structure sets to mask stacks (PS3.3, C.8.8.6): closed planar contours on any planes.

Each contour is filled by the even-odd rule, so that a keyhole's channel, which is run through twice, encloses
nothing. Contours of one region and plane are put together as their type says:

- CLOSEDPLANAR_XOR: what an odd number of them encloses.
- CLOSED_PLANAR: contours that overlap in part are united. One inside another takes away, as nearly all who write
  such contours mean it, and one inside that adds again.

A contour that comes twice counts once. One that encloses no pixel's centre stands for the pixel at its middle. Several
regions are joined. A label is an ROI number. Points, open contours, those of fewer than three points and those without
an area (points on a line, halves that cancel each other) are passed over, as are regions without another contour.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from pydicom import Dataset
from skimage.draw import polygon2mask

from model.errors import InvalidGeometry, InvalidMask
from model.geometry import Grid
from model.inference.mask_stack import MaskStack
from service.adapters.dicom.objects import tolerant
from service.adapters.dicom.planes import PARALLEL, REGULAR_SHARE, DrawnStack, FramePlane, drawn_stacks, on_images
from service.adapters.dicom.segmentations import listed, require_room, stacks_of
from service.adapters.image_guard import LPS_TO_RAS, ImageLimits

#: Geometric types that enclose an area; of the second one those of a region and plane take each other away.
CLOSED = ("CLOSED_PLANAR", "CLOSEDPLANAR_XOR")
#: Numbers of a contour's data below which it encloses nothing.
SMALLEST_CONTOUR = 9
#: A contour has no area where twice its area through its extent is less than this (mm).
NARROWEST_MM = 1e-3
#: Distance of a contour's points from their common plane that is tolerated (mm).
FLATNESS_MM = 0.1
#: Digits (of mm) in which contours agree that are the same.
SAME_DIGITS = 3
#: Share of a contour's area that one inside it has at least when it is the same, rounded otherwise.
SAME_AREA = 0.9
#: Pixels of planes that no image says: this share of the drawing's extent, within the range (mm).
PIXEL_SHARE, PIXEL_RANGE_MM = 1 / 128, (0.25, 1.0)
#: Free room around a drawing without an image (mm).
MARGIN_MM = 20.0


@dataclass(frozen=True)
class Contour:
    """A closed planar contour, LPS mm.

    Attributes:
        region: its ROI number.
        points: in their order.
        normal: of its plane, a unit vector.
        area: that it encloses (mm2).
        is_xor: whether it is of the type CLOSEDPLANAR_XOR.
    """

    region: int
    points: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "3"]
    area: float
    is_xor: bool

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """Mean of its points (mm)."""
        return np.asarray(self.points.mean(axis=0))


def read_structure_set(
    found: Dataset,
    part: str,
    limits: ImageLimits,
    labels: frozenset[int] | None = None,
    home: Grid | None = None,
) -> tuple[MaskStack, ...]:
    """The stacks of the object that the contours draw.

    Args:
        labels: ROI numbers of the object; all of them when None.
        home: grid of the images that were drawn on; contours on their planes are drawn on its pixels.

    Raises:
        UnreadableImage, InvalidGeometry: damaged, or contours that are not planar or lie beside the images.
        InvalidMask: no closed contour with an area, or a region that the object does not have.
        TooLarge: over a limit.
    """
    groups = _by_direction(closed_contours(found, part, labels))
    grids: list[Grid] = []
    volumes, drawn = [], []
    for group in groups:
        sheets = _sheets(group)
        stacks = _stacks_of_sheets(sheets, group[0].normal, home, limits.max_voxels / len(groups))
        grids += [stack.grid for stack in stacks]
        require_room(grids, part, limits)
        volumes += [_painted(stack, sheets, part) for stack in stacks]
        drawn += [np.unique(stack.places) for stack in stacks]
    return stacks_of(part, grids, volumes, drawn)


def _painted(stack: DrawnStack, sheets: Sequence[list[Contour]], part: str) -> Bool[np.ndarray, "i j k"]:
    """What the contours of the planes on a stack enclose."""
    volume = np.zeros(stack.grid.shape, bool)
    for number, place in zip(stack.numbers.tolist(), stack.places.tolist(), strict=True):
        volume[:, :, place] |= _filled(sheets[number], stack.grid, part)
    return volume


def closed_contours(found: Dataset, part: str, labels: frozenset[int] | None) -> list[Contour]:
    """The closed planar contours of the chosen regions, the largest first."""
    with tolerant(part):
        points = [
            (number, _points(item), item.ContourGeometricType == CLOSED[1])
            for number, items in _drawn_regions(found, part, labels).items()
            for item in items
        ]
        regions = labels or {int(region.ROINumber) for region in found.get("StructureSetROISequence") or []}
    if not points:
        where = f" of region {listed(regions)}" if regions else ""
        raise InvalidMask(
            f"{part} holds no closed planar contour around an area{where}; one or more are needed", part=part
        )
    contours = [_flat(*contour, part) for contour in points]
    return sorted(contours, key=lambda contour: contour.area, reverse=True)


def drawn_regions(found: Dataset, part: str) -> frozenset[int]:
    """Numbers of the regions that have a closed contour around an area."""
    with tolerant(part):
        return frozenset(_drawn_regions(found, part, None))


def frame_of_regions(found: Dataset, part: str, labels: frozenset[int] | None = None) -> str:
    """UID of the frame of reference that the chosen regions are drawn in; empty when none says it.

    Raises:
        InvalidMask: a region that the object does not have.
        InvalidGeometry: regions of several frames of reference.
    """
    frames: dict[str, list[int]] = defaultdict(list)
    with tolerant(part):
        drawn = _drawn_regions(found, part, labels)
        for region in found.get("StructureSetROISequence") or []:
            frame = str(region.get("ReferencedFrameOfReferenceUID") or "")
            if frame and int(region.ROINumber) in drawn:
                frames[frame].append(int(region.ROINumber))
    if len(frames) > 1:
        places = " and ".join(f"region {listed(numbers)}" for numbers in frames.values())
        raise InvalidGeometry(
            f"{part} draws {places} in different frames of reference; regions of one frame are accepted", part=part
        )
    return next(iter(frames), "")


def images_of_regions(found: Dataset, part: str, labels: frozenset[int] | None = None) -> list[str]:
    """SOP Instance UIDs of the images that the chosen regions' closed contours name, as often as they do."""
    with tolerant(part):
        return [
            str(image.ReferencedSOPInstanceUID)
            for items in _drawn_regions(found, part, labels).values()
            for item in items
            for image in item.get("ContourImageSequence") or []
        ]


def _drawn_regions(found: Dataset, part: str, labels: frozenset[int] | None) -> dict[int, list[Dataset]]:
    """The closed planar contours around an area of each chosen region that has any; call within `tolerant`."""
    drawn: dict[int, list[Dataset]] = defaultdict(list)
    known = {int(region.ROINumber) for region in found.get("StructureSetROISequence") or []}
    for region in found.get("ROIContourSequence") or []:
        number = int(region.ReferencedROINumber)
        known.add(number)
        if labels is None or number in labels:
            drawn[number] += [item for item in region.get("ContourSequence") or [] if _has_area(item)]
    if labels is not None and not labels <= known:
        raise InvalidMask(
            f"{part} has no region {listed(labels - known)}; regions that are there: {listed(known) or 'none'}",
            part=part,
        )
    return {number: items for number, items in drawn.items() if items}


def _has_area(item: Dataset) -> bool:
    """Whether an item is a closed contour around an area; call within `tolerant`."""
    if item.ContourGeometricType not in CLOSED or len(item.ContourData) < SMALLEST_CONTOUR:
        return False
    points = _points(item)
    extent_mm = max(np.ptp(points, axis=0).max(), NARROWEST_MM)
    return not np.linalg.norm(_twice_area(points)) < NARROWEST_MM * extent_mm


def _points(item: Dataset) -> Float[np.ndarray, "n 3"]:
    return np.array(item.ContourData, float).reshape(-1, 3)


def _twice_area(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """The normal of a contour (Newell), as long as its area twice (mm2)."""
    spokes = points - points.mean(axis=0)
    return np.asarray(np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0))


def _flat(region: int, points: Float[np.ndarray, "n 3"], is_xor: bool, part: str) -> Contour:
    """A contour with its normal, turned so that its largest component is positive."""
    middle, area = points.mean(axis=0), _twice_area(points)
    length = np.linalg.norm(area)
    normal = area / length
    if not np.isfinite(points).all() or not np.abs((points - middle) @ normal).max() <= FLATNESS_MM:
        raise InvalidGeometry(f"{part} has a contour that does not lie in a plane; planar ones are accepted", part=part)
    return Contour(region, points, normal * np.sign(normal[np.argmax(np.abs(normal))]), float(length) / 2, is_xor)


def _by_direction(contours: Sequence[Contour]) -> list[list[Contour]]:
    """Contours whose planes are parallel; the largest, whose normal is surest, stays the first of each."""
    groups: list[list[Contour]] = []
    for contour in contours:
        home = next((group for group in groups if _parallel(group[0], contour)), None)
        if home is None:
            groups.append([contour])
        else:
            home.append(contour)
    return groups


def _sheets(group: Sequence[Contour]) -> list[list[Contour]]:
    """Parallel contours by the plane they lie in, from the lowest to the highest.

    Each may lie off its plane by `FLATNESS_MM`. Where the planes are far apart, so may two of one plane.
    """
    heights = np.array([group[0].normal @ contour.middle for contour in group])
    order = np.argsort(heights, kind="stable")
    gaps = np.diff(heights[order])
    usual = np.median(gaps[gaps > FLATNESS_MM]) if (gaps > FLATNESS_MM).any() else 0.0
    apart = min(max(FLATNESS_MM, REGULAR_SHARE * usual), 2 * FLATNESS_MM)
    sheets: list[list[int]] = [[]]
    for number in order.tolist():
        if sheets[-1] and heights[number] - heights[sheets[-1][0]] > apart:
            sheets.append([])
        sheets[-1].append(number)
    return [[group[number] for number in sorted(sheet)] for sheet in sheets]


def _parallel(first: Contour, second: Contour) -> bool:
    return bool(np.linalg.norm(np.cross(first.normal, second.normal)) <= 10 * PARALLEL)


def _stacks_of_sheets(
    sheets: Sequence[list[Contour]], normal: Float[np.ndarray, "3"], home: Grid | None, most_voxels: float
) -> list[DrawnStack]:
    """Stacks that hold each plane of a direction: the images' grid where the planes are theirs."""
    if home is not None and np.linalg.norm(np.cross(home.directions[:, 2], _ras(normal))) < 10 * PARALLEL:
        index = home.to_index(np.array([_ras(sheet[0].middle) for sheet in sheets]))[:, 2]
        near = np.abs(index - np.rint(index)).max() <= max(FLATNESS_MM / home.spacing[2], REGULAR_SHARE)
        if near and index.min() > -0.5 and index.max() < home.shape[2] - 0.5:
            return [on_images(home, np.rint(index).astype(int), most_voxels)]
    return _own_stacks(sheets, normal, most_voxels)


def _ras(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return np.asarray(vectors @ LPS_TO_RAS[:3, :3])


def _own_stacks(
    sheets: Sequence[list[Contour]], across: Float[np.ndarray, "3"], most_voxels: float
) -> list[DrawnStack]:
    """Stacks on pixels that suit the drawing, with room around it."""
    points = np.concatenate([contour.points for sheet in sheets for contour in sheet])
    row, column = _axes(across)
    along = points @ np.stack([row, column]).T
    low, high = along.min(axis=0) - MARGIN_MM, along.max(axis=0) + MARGIN_MM
    pixel = float(np.clip((high - low).max() * PIXEL_SHARE, *PIXEL_RANGE_MM))
    columns, rows = (int(n) for n in np.ceil((high - low) / pixel) + 1)
    normal = np.cross(row, column)
    corner = low[0] * row + low[1] * column
    planes = [
        FramePlane(corner + normal * (sheet[0].points @ normal).mean(), row, column, (pixel, pixel), np.nan)
        for sheet in sheets
    ]
    return drawn_stacks(planes, columns, rows, most_voxels, MARGIN_MM)


def _axes(normal: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Row and column directions of a plane, as near to the patient's axes as can be."""
    nearest = np.eye(3)[int(np.argmin(np.abs(normal)))]
    row = nearest - (nearest @ normal) * normal
    row /= np.linalg.norm(row)
    return row, np.asarray(np.cross(normal, row))


def _filled(sheet: Sequence[Contour], grid: Grid, part: str) -> Bool[np.ndarray, "i j"]:
    """Pixels that the contours of one plane, the largest first, enclose: those of any region."""
    regions: dict[int, dict[bytes, Contour]] = defaultdict(dict)
    for contour in sheet:
        regions[contour.region].setdefault(_identity(contour), contour)
    filled = np.zeros(grid.shape[:2], bool)
    for contours in regions.values():
        filled |= _filled_region(list(contours.values()), grid, part)
    return filled


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
    filled = nest.filled ^ crossed
    for column, row in specks:
        filled[column, row] = True
    return filled


def _enclosed(contour: Contour, grid: Grid) -> Bool[np.ndarray, "i j"]:
    """Pixels whose centres a contour encloses by the even-odd rule."""
    index = grid.to_index(_ras(contour.points))[:, :2]
    return np.asarray(polygon2mask(grid.shape[:2], index))  # type: ignore[no-untyped-call]


def _pixel_of(contour: Contour, grid: Grid, part: str) -> tuple[int, int]:
    """The pixel at the middle of a contour that encloses no pixel's centre."""
    column, row = (round(i) for i in grid.to_index(_ras(contour.middle[None]))[0, :2].tolist())
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
