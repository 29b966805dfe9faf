"""Drawn objects of DICOM, by their class: segmentations and structure sets."""

from dataclasses import replace
from typing import BinaryIO

from pydicom import Dataset
from pydicom.uid import UID, RTStructureSetStorage

from model.errors import InvalidMask, UnreadableImage
from model.geometry import Grid
from model.inference.mask_stack import MaskStack
from service.adapters.dicom.objects import read_object, tolerant
from service.adapters.dicom.segmentations import SEGMENTATIONS, read_segmentation
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
        home: grid of the images that were drawn on, if they are at hand; drawings on them lie on it.

    Raises:
        UnreadableImage: neither SEG nor RTSTRUCT, or damaged.
        InvalidMask, InvalidGeometry, InvalidParameter, TooLarge: as the readers say.
    """
    with tolerant(part):
        kind = found.get("SOPClassUID")
    if kind in SEGMENTATIONS:
        stacks = read_segmentation(found, part, limits, labels, home)
    elif kind == RTStructureSetStorage:
        stacks = read_structure_set(found, part, limits, labels, home)
    else:
        raise UnreadableImage(
            f"{part} is a DICOM object of another kind; segmentations (SEG) and structure sets (RTSTRUCT) are accepted",
            part=part,
        )
    return tuple(replace(stack, space="LPS") for stack in stacks)


def referenced_series(found: Dataset) -> UID:
    """Series Instance UID of the images that were drawn on.

    Raises:
        InvalidMask: the object refers to no series.
    """
    with tolerant("object"):
        if found.SOPClassUID == RTStructureSetStorage:
            items = [
                series
                for frame in found.get("ReferencedFrameOfReferenceSequence") or []
                for study in frame.get("RTReferencedStudySequence") or []
                for series in study.get("RTReferencedSeriesSequence") or []
            ]
        else:
            items = list(found.get("ReferencedSeriesSequence") or [])
        if items:
            return UID(items[0].SeriesInstanceUID)
    raise InvalidMask("The object refers to no series of images; a drawing on images is accepted.", part="object")
