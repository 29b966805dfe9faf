"""Drawn objects of DICOM, by their class: segmentations and structure sets."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import BinaryIO

from pydicom import Dataset
from pydicom.uid import UID, RTStructureSetStorage

from model.errors import InvalidGeometry, InvalidMask, UnreadableImage
from model.geometry import Grid
from model.inference.mask_stack import MaskStack
from model.inference.stacks import checked_labels
from service.adapters.dicom.contours import drawn_regions, frame_of_regions, images_of_regions
from service.adapters.dicom.objects import read_object, tolerant
from service.adapters.dicom.planes import ImageGrid
from service.adapters.dicom.segmentations import SEGMENTATIONS, drawn_segments, read_segmentation
from service.adapters.dicom.structure_sets import read_structure_set
from service.adapters.image_guard import ImageLimits

#: SOP classes of drawings that are read.
DRAWINGS = (*SEGMENTATIONS, RTStructureSetStorage)


def read_dicom_mask(
    file: BinaryIO, part: str, limits: ImageLimits, labels: frozenset[int] | None = None
) -> tuple[MaskStack, ...]:
    """The mask stacks of one file of checked length; errors as in `stacks_of_object`."""
    return stacks_of_object(read_object(file, part), part, limits, labels)


def stacks_of_object(
    found: Dataset,
    part: str,
    limits: ImageLimits,
    labels: frozenset[int] | None = None,
    home: Grid | None = None,
) -> tuple[MaskStack, ...]:
    """One mask stack for each direction of planes that the object draws on; their grids are RAS, answers are LPS.

    Args:
        labels: numbers of segments or regions; all when None.
        home: grid of the images that were drawn on, if they are at hand; drawings on them lie on it. When it says
            in which frame of reference it lies (`ImageGrid`), the drawing has to lie in the same.

    Raises:
        UnreadableImage: neither SEG nor RTSTRUCT, or damaged.
        InvalidGeometry: drawn in several frames of reference, or in another than the images'.
        InvalidMask, InvalidGeometry, InvalidParameter, TooLarge: as the readers say.
    """
    checked_labels(labels)
    return _stacks(found, part, limits, labels, home)


def stacks_by_label(
    found: Dataset, part: str, limits: ImageLimits, home: Grid | None = None
) -> Iterator[tuple[int, tuple[MaskStack, ...]]]:
    """The stacks of each segment or region that draws something by itself, in the order of the object.

    Errors are those of `stacks_of_object`, with all labels where nothing is drawn at all.
    """
    with tolerant(part):
        is_drawing = found.get("SOPClassUID") in DRAWINGS
    drawn = drawn_labels(found, part) if is_drawing else frozenset()
    if not drawn:
        _stacks(found, part, limits, None, home)
    for number in label_names(found, part):
        if number in drawn:
            yield number, _stacks(found, part, limits, frozenset([number]), home)


def _stacks(
    found: Dataset, part: str, limits: ImageLimits, labels: frozenset[int] | None, home: Grid | None
) -> tuple[MaskStack, ...]:
    """As `stacks_of_object`, of any numbers that segments and regions can have."""
    with tolerant(part):
        kind = found.get("SOPClassUID")
    if kind not in DRAWINGS:
        raise UnreadableImage(
            f"{part} is a DICOM object of another kind; segmentations (SEG) and structure sets (RTSTRUCT) are accepted",
            part=part,
        )
    _require_frame(frame_of_reference(found, part, labels), part, home)
    read = read_segmentation if kind in SEGMENTATIONS else read_structure_set
    return tuple(replace(stack, space="LPS") for stack in read(found, part, limits, labels, home))


def drawn_labels(found: Dataset, part: str) -> frozenset[int]:
    """Numbers of the segments or regions that draw something: a voxel, or a closed contour around an area.

    Raises:
        UnreadableImage, InvalidMask: damaged, or pixels that are no segmentation's.
    """
    with tolerant(part):
        is_structures = found.SOPClassUID == RTStructureSetStorage
    return drawn_regions(found, part) if is_structures else drawn_segments(found, part)


def label_names(found: Dataset, part: str) -> dict[int, str]:
    """Names of the segments or regions by number; empty where they have none."""
    with tolerant(part):
        if found.SOPClassUID == RTStructureSetStorage:
            return {int(item.ROINumber): str(item.get("ROIName") or "") for item in found.StructureSetROISequence}
        return {int(item.SegmentNumber): str(item.get("SegmentLabel") or "") for item in found.SegmentSequence}


def frame_of_reference(found: Dataset, part: str, labels: frozenset[int] | None = None) -> str:
    """UID of the frame of reference that the chosen segments or regions are drawn in; empty when the object says none.

    Raises:
        InvalidGeometry: regions of several.
    """
    with tolerant(part):
        if found.SOPClassUID == RTStructureSetStorage:
            return frame_of_regions(found, part, labels)
        return str(found.get("FrameOfReferenceUID") or "")


def _require_frame(frame: str, part: str, home: Grid | None) -> None:
    images = home.frame_of_reference if isinstance(home, ImageGrid) else ""
    if frame and images and frame != images:
        raise InvalidGeometry(
            f"{part} is drawn in another frame of reference than that of its images; one in theirs is accepted",
            part=part,
        )


@dataclass(frozen=True)
class _Reference:
    """A series that a drawing refers to: its UID, its images, its frame of reference and its study where said."""

    series: UID
    images: tuple[str, ...]
    frame: str = ""
    study: str = ""


def referenced_series(found: Dataset, labels: frozenset[int] | None = None) -> UID:
    """Series Instance UID of the images that were drawn on.

    Of several series it is that whose images most of the chosen contours (or the frames) name; where they name
    none, the first in the frame of reference of the chosen regions.

    Args:
        labels: ROI numbers that count; all when None.

    Raises:
        InvalidMask: the object refers to no series.
        InvalidGeometry: the regions are drawn in several frames of reference.
    """
    with tolerant("object"):
        is_structures = found.SOPClassUID == RTStructureSetStorage
        references = list(_references(found))
        if not references:
            raise InvalidMask(
                "The object refers to no series of images; a drawing on images is accepted.", part="object"
            )
        if len({reference.series for reference in references}) == 1:
            return references[0].series
        named = Counter(images_of_regions(found, "object", labels) if is_structures else _images_of_frames(found))
        frame = frame_of_reference(found, "object", labels)
        best = max(references, key=lambda r: (sum(named[image] for image in r.images), r.frame == frame))
        return best.series


def referenced_studies(found: Dataset, series: str) -> tuple[str, ...]:
    """Study Instance UIDs that a series may be in: the drawing's own, then those that it names for the series.

    Raises:
        UnreadableImage: damaged.
    """
    with tolerant("object"):
        named = [reference.study for reference in _references(found) if reference.series == series and reference.study]
        return tuple(dict.fromkeys([str(found.StudyInstanceUID), *named]))


def _references(found: Dataset) -> Iterator[_Reference]:
    is_structures = found.SOPClassUID == RTStructureSetStorage
    yield from _of_structures(found) if is_structures else _of_segmentation(found)


def _of_structures(found: Dataset) -> Iterator[_Reference]:
    for frame in found.get("ReferencedFrameOfReferenceSequence") or []:
        for study in frame.get("RTReferencedStudySequence") or []:
            for series in study.get("RTReferencedSeriesSequence") or []:
                named = _reference(series, "ContourImageSequence", str(study.get("ReferencedSOPInstanceUID") or ""))
                yield replace(named, frame=str(frame.get("FrameOfReferenceUID") or ""))


def _of_segmentation(found: Dataset) -> Iterator[_Reference]:
    for series in found.get("ReferencedSeriesSequence") or []:
        yield _reference(series, "ReferencedInstanceSequence")
    for study in found.get("StudiesContainingOtherReferencedInstancesSequence") or []:
        for series in study.get("ReferencedSeriesSequence") or []:
            yield _reference(series, "ReferencedInstanceSequence", str(study.StudyInstanceUID))


def _reference(series: Dataset, name: str, study: str = "") -> _Reference:
    images = tuple(str(image.ReferencedSOPInstanceUID) for image in series.get(name) or [])
    return _Reference(UID(series.SeriesInstanceUID), images, study=study)


def _images_of_frames(found: Dataset) -> Iterator[str]:
    for frame in found.get("PerFrameFunctionalGroupsSequence") or []:
        for derivation in frame.get("DerivationImageSequence") or []:
            for source in derivation.get("SourceImageSequence") or []:
                yield str(source.ReferencedSOPInstanceUID)
