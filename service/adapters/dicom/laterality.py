"""The side of the body that a drawn structure is on, as the codes of the drawing say it (PS3.16, CID 244)."""

from collections.abc import Iterable, Iterator
from typing import Any

from pydicom import Dataset
from pydicom.sr.coding import Code

from model.errors import UnreadableImage
from service.adapters.dicom.objects import tolerant

#: Codes by the letters of Frame Laterality (PS3.3, C.7.6.16.2.8), and its letter for a structure without sides.
SIDES = {
    "L": Code("7771000", "SCT", "Left"),
    "R": Code("24028007", "SCT", "Right"),
    "B": Code("51440002", "SCT", "Right and left"),
}
UNPAIRED = "U"

#: The same in the codes that the standard had before SNOMED CT's.
_EARLIER = {("SRT", "G-A101"): "L", ("SRT", "G-A100"): "R", ("SRT", "G-A102"): "B"}
_LETTERS = {(code.scheme_designator, code.value): letter for letter, code in SIDES.items()} | _EARLIER
_CODED = ("SegmentedPropertyTypeCodeSequence", "AnatomicRegionSequence", "RTROIIdentificationCodeSequence")
_MODIFIERS = ("SegmentedPropertyTypeModifierCodeSequence", "AnatomicRegionModifierSequence")


def side_of(drawing: Dataset, labels: frozenset[int] | None = None) -> str:
    """Letter of the side in `SIDES`; empty where the drawing does not say one, or its structures are on several.

    Args:
        drawing: a segmentation or a structure set.
        labels: numbers of the segments or regions that count; all when None.
    """
    try:
        with tolerant("drawing"):
            said = {letter for item in _structures(drawing, labels) for letter in _letters(item)}
    except UnreadableImage:
        return ""
    return said.pop() if len(said) == 1 else ""


def _structures(drawing: Dataset, labels: frozenset[int] | None) -> Iterator[Dataset]:
    """Descriptions of the chosen segments, or observations of the chosen regions."""
    for items, number in (("SegmentSequence", "SegmentNumber"), ("RTROIObservationsSequence", "ReferencedROINumber")):
        for item in drawing.get(items) or ():
            if labels is None or int(item.get(number) or 0) in labels:
                yield item


def _letters(structure: Dataset) -> Iterator[str]:
    coded: list[Any] = [structure, *(code for name in _CODED for code in structure.get(name) or ())]
    yield from _known(modifier for item in coded for name in _MODIFIERS for modifier in item.get(name) or ())


def _known(modifiers: Iterable[Dataset]) -> Iterator[str]:
    for modifier in modifiers:
        letter = _LETTERS.get((str(modifier.get("CodingSchemeDesignator")), str(modifier.get("CodeValue"))))
        if letter is not None:
            yield letter
