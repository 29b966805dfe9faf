"""Closed planar contours of RT structure sets (PS3.3, C.8.8.6): which there are, and where they lie."""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pydicom import Dataset

from model.errors import InvalidGeometry, InvalidMask, TooLarge
from service.adapters.dicom.objects import tolerant
from service.adapters.dicom.segmentations import listed
from service.adapters.image_guard import LPS_TO_RAS

#: Geometric types that enclose an area; of the second one those of a region and plane take each other away.
CLOSED = ("CLOSED_PLANAR", "CLOSEDPLANAR_XOR")
#: Points below which a contour encloses nothing.
FEWEST_POINTS = 3
#: A contour has no area where twice its area through its extent is less than this (mm).
NARROWEST_MM = 1e-3
#: Distance of a contour's points from their common plane that is tolerated (mm).
FLATNESS_MM = 0.1
#: Closed contours, points in one of them and in all, that the regions which are read together have at most.
MOST_CONTOURS, MOST_OF_ONE, MOST_POINTS = 1 << 16, 1 << 18, 1 << 22


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


def closed_contours(found: Dataset, part: str, labels: frozenset[int] | None) -> list[Contour]:
    """The closed planar contours of the chosen regions, the largest first."""
    with tolerant(part):
        drawn = [
            (number, points, item.ContourGeometricType == CLOSED[1])
            for number, items in _drawn_regions(found, part, labels).items()
            for item, points in items
        ]
        regions = labels or {int(region.ROINumber) for region in found.get("StructureSetROISequence") or []}
    if not drawn:
        where = f" of region {listed(regions)}" if regions else ""
        raise InvalidMask(
            f"{part} holds no closed planar contour around an area{where}; one or more are needed", part=part
        )
    contours = [_flat(*contour, part) for contour in drawn]
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
            for item, _ in items
            for image in item.get("ContourImageSequence") or []
        ]


def _drawn_regions(
    found: Dataset, part: str, labels: frozenset[int] | None
) -> dict[int, list[tuple[Dataset, Float[np.ndarray, "n 3"]]]]:
    """The closed planar contours around an area of each chosen region that has any, and their points (mm).

    Call within `tolerant`.
    """
    drawn: dict[int, list[tuple[Dataset, Float[np.ndarray, "n 3"]]]] = defaultdict(list)
    known = {int(region.ROINumber) for region in found.get("StructureSetROISequence") or []}
    contours = points = 0
    for region in found.get("ROIContourSequence") or []:
        number = int(region.ReferencedROINumber)
        known.add(number)
        for item in region.get("ContourSequence") or [] if labels is None or number in labels else []:
            if item.ContourGeometricType not in CLOSED:
                continue
            own = _count(item) // 3
            contours, points = contours + 1, points + own
            if contours > MOST_CONTOURS or own > MOST_OF_ONE or points > MOST_POINTS:
                raise TooLarge(
                    f"{part} has more than {MOST_CONTOURS} closed contours, {MOST_OF_ONE} points in one or "
                    f"{MOST_POINTS} in all, the most that are accepted; choose regions, or draw them with fewer points",
                    part=part,
                )
            if own >= FEWEST_POINTS and _has_area(data := _points(item)):
                drawn[number].append((item, data))
    if labels is not None and not labels <= known:
        raise InvalidMask(
            f"{part} has no region {listed(labels - known)}; regions that are there: {listed(known) or 'none'}",
            part=part,
        )
    return dict(drawn)


def _count(item: Dataset) -> int:
    """How many numbers a contour's data holds, before one of them is read."""
    value = item.get_item("ContourData").value
    return value.count(b"\\") + 1 if isinstance(value, bytes) and value else len(value or ())


def _points(item: Dataset) -> Float[np.ndarray, "n 3"]:
    """A contour's points (mm), read at once: number by number the library would take forty times the room."""
    value = item.get_item("ContourData").value
    return np.array(value.split(b"\\") if isinstance(value, bytes) else value, float).reshape(-1, 3)


def _has_area(points: Float[np.ndarray, "n 3"]) -> bool:
    extent_mm = max(np.ptp(points, axis=0).max(), NARROWEST_MM)
    return not np.linalg.norm(_twice_area(points)) < NARROWEST_MM * extent_mm


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


def ras(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Vectors of DICOM's world (LPS) in that of grids."""
    return np.asarray(vectors @ LPS_TO_RAS[:3, :3])
