"""The Basic Application Level Confidentiality Profile on one data set (PS3.15, E.1).

What becomes of an element says the standard's table (E.1-1) as the library dicom-anonymizer holds it. The library
blanks references to images within sequences and leaves the items of other sequences alone, so that the table is
applied here. Elements that no table lists but that hold what people type are cleared as well, and what the data
dictionary does not know goes with the private elements.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

from dicomanonymizer import simpledicomanonymizer as library
from pydicom import DataElement, Dataset
from pydicom.datadict import dictionary_has_tag, repeater_has_tag, tag_for_keyword
from pydicom.sequence import Sequence as Items
from pydicom.tag import BaseTag, Tag

#: Edition of the table.
EDITION = "dicomfields_2026c"
#: Acts on an element of a data set, by its group and number.
Action = Callable[[Dataset, tuple[int, int]], None]

#: Elements that the table lacks: identifiers, addresses that hold some, and texts that people type, which an object
#: may be without.
REMOVED = (
    *("SegmentDescription", "FrameOfInterestDescription", "SurfaceComments", "ReferenceLocationDescription"),
    *("GraphicLayerDescription", "GraphicGroupDescription", "FiducialDescription"),
    *("CommentsOnTheScheduledProcedureStep", "RequestedProcedureDescriptionTrial"),
    *("PlacerOrderNumberProcedure", "FillerOrderNumberProcedure", "HL7InstanceIdentifier"),
    *("PlacerOrderNumberImagingServiceRequestRetired", "FillerOrderNumberImagingServiceRequestRetired"),
    *("LocalNamespaceEntityID", "UniversalEntityID", "DeviceID", "GridID", "ImageID"),
    *("PatientBirthDateInAlternativeCalendar", "PatientDeathDateInAlternativeCalendar"),
    *("SecondaryReviewerName", "EvaluatorName", "DocumentAuthorTrial"),
    *("RetrieveURL", "RetrieveURI", "StorageURL", "StoredInstanceBaseURI", "FolderAccessURI", "FileAccessURI"),
)
#: Texts that it lacks and an object has to have, if without a value (type 2).
EMPTIED = ("ContentDescription", "DocumentTitle")
#: Texts that it lacks and an object has to have.
REPLACED = ("ContentLabel", "TrackingID", "TextValue")
#: Identifiers that it lacks.
RENUMBERED = (
    *("MultiFrameSourceSOPInstanceUID", "SOPInstanceUIDOfConcatenationSource", "RetrieveLocationUID"),
    *("TargetFrameOfReferenceUID", "VolumeFrameOfReferenceUID", "TableFrameOfReferenceUID"),
    *("EquipmentFrameOfReferenceUID", "ReferencedFiducialUID", "RadiopharmaceuticalAdministrationEventUID"),
)
#: Sequences whose items stay: after the profile they hold classes and new UIDs.
KEPT = ("ReferencedPerformedProcedureStepSequence",)
#: Group of overlays: without its data an overlay is nothing, and its other elements hold texts.
OVERLAYS = (0x6000, 0x0000, 0xFF00, 0x0000)
#: Values for dates and times that an object needs; the library's are of a year that checkers refuse.
DUMMIES = {"DA": "19000101", "DT": "19000101000000.000000+0000", "TM": "000000.00"}

_REMOVING = (library.delete, library.delete_or_replace, library.delete_or_empty_or_replace)
_EMPTYING = (library.empty, library.delete_or_empty, library.empty_or_replace)


def apply_profile(found: Dataset) -> None:
    """Clear a data set and the items of its sequences, in place; UIDs get the same new ones throughout one run.

    Raises:
        ValueError, NotImplementedError, ...: a value that cannot be decoded or has no substitute.
    """
    for tag in list(found.keys()):
        if tag.is_private or not (dictionary_has_tag(tag) or repeater_has_tag(tag)):
            del found[tag]
            continue
        element, action = found[tag], _action(tag)
        if element.VR == "SQ":
            _apply_to_sequence(found, element, action)
        elif action is not None:
            _apply_to_value(found, element, action)


def _apply_to_value(found: Dataset, element: DataElement, action: Action) -> None:
    if action == library.delete:
        del found[element.tag]
    elif not element.is_empty:
        action(found, (element.tag.group, element.tag.element))
        if element.tag in found and element.VR in DUMMIES:
            found[element.tag].value = DUMMIES[element.VR]


def _apply_to_sequence(found: Dataset, element: DataElement, action: Action | None) -> None:
    if action in _REMOVING:
        del found[element.tag]
    elif action in _EMPTYING:
        element.value = Items()
    else:
        for item in element.value:
            apply_profile(item)
        if action is not None and action is library.replace:
            action(found, (element.tag.group, element.tag.element))


@cache
def _actions() -> tuple[dict[BaseTag, Action], tuple[tuple[tuple[int, ...], Action], ...]]:
    """By element, and by pattern for groups that repeat."""
    table: dict[tuple[int, ...], Action] = {**library.initialize_actions(EDITION), OVERLAYS: library.delete}
    single = {Tag(tag): action for tag, action in table.items() if len(tag) == 2}
    for names, action in (
        (REMOVED, library.delete),
        (EMPTIED, library.empty),
        (REPLACED, library.replace),
        (RENUMBERED, library.replace_UID),
        (KEPT, library.keep),
        (("SegmentLabel",), _coded_label),
    ):
        single |= {Tag(_tag(name)): action for name in names}
    return single, tuple((tag, action) for tag, action in table.items() if len(tag) > 2)


def _tag(keyword: str) -> int:
    tag = tag_for_keyword(keyword)
    if tag is None:
        raise LookupError(f"The data dictionary has no {keyword}.")
    return tag


def _action(tag: BaseTag) -> Action | None:
    single, repeated = _actions()
    for (group, number, group_mask, number_mask), action in repeated:
        if tag.group & group_mask == group & group_mask and tag.element & number_mask == number & number_mask:
            return action
    return single.get(tag)


def _coded_label(segment: Dataset, tag: tuple[int, int]) -> None:
    """What a segment is of by its code, in place of what somebody called it."""
    kinds: Any = segment.get("SegmentedPropertyTypeCodeSequence")
    segment[tag].value = (kinds and kinds[0].get("CodeMeaning")) or "Segment"
