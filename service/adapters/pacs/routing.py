"""From an incoming object to the rule that takes it, by what its header says."""

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from pydicom import Dataset
from pydicom.uid import RTStructureSetStorage

from service.adapters.dicom.derivation import MANUFACTURER
from service.adapters.dicom.masks import DRAWINGS
from service.adapters.dicom.objects import tolerant
from service.adapters.pacs.configuration import Rule


@dataclass(frozen=True)
class Segment:
    """One segment or region: its number, its name, and the codes of what it is."""

    number: int
    label: str
    codes: frozenset[str]


@dataclass(frozen=True)
class Match:
    """The rule that takes an object, and the numbers of the segments or regions that it means."""

    rule: Rule
    labels: frozenset[int] | None


def find_rule(rules: Sequence[Rule], found: Dataset, sender: str) -> Match | None:
    """The first rule whose conditions all hold; None for other objects, results of this program among them.

    Raises:
        UnreadableImage: a header that cannot be read.
    """
    with tolerant("object"):
        if found.get("SOPClassUID") not in DRAWINGS or found.get("Manufacturer") == MANUFACTURER:
            return None
        segments, body_part = _segments(found), str(found.get("BodyPartExamined") or "")
    for rule in rules:
        wanted = [segment for segment in segments if _means(rule, segment)]
        if wanted and _is_from(rule, sender) and _holds(rule.body_parts, body_part):
            named = bool(rule.segment_codes or rule.segment_labels)
            return Match(rule, frozenset(segment.number for segment in wanted) if named else None)
    return None


def _segments(found: Dataset) -> list[Segment]:
    if found.SOPClassUID == RTStructureSetStorage:
        observed = {
            int(item.ReferencedROINumber): _codes(item, "RTROIIdentificationCodeSequence")
            for item in found.get("RTROIObservationsSequence") or []
        }
        regions = [(int(item.ROINumber), str(item.get("ROIName") or "")) for item in found.StructureSetROISequence]
        return [Segment(number, name, observed.get(number, frozenset())) for number, name in regions]
    return [
        Segment(
            int(item.SegmentNumber),
            str(item.get("SegmentLabel") or ""),
            _codes(item, "SegmentedPropertyTypeCodeSequence") | _codes(item, "AnatomicRegionSequence"),
        )
        for item in found.SegmentSequence
    ]


def _codes(item: Dataset, name: str) -> frozenset[str]:
    return frozenset(f"{code.get('CodingSchemeDesignator')}:{code.get('CodeValue')}" for code in item.get(name) or [])


def _means(rule: Rule, segment: Segment) -> bool:
    coded = not rule.segment_codes or not segment.codes.isdisjoint(rule.segment_codes)
    label = segment.label.casefold()
    patterns = [pattern.casefold() for pattern in rule.segment_labels]
    return coded and (not patterns or any(fnmatchcase(label, pattern) for pattern in patterns))


def _is_from(rule: Rule, sender: str) -> bool:
    return _holds(rule.senders, sender)


def _holds(accepted: Sequence[str], value: str) -> bool:
    return not accepted or value in accepted
