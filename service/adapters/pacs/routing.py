"""From an incoming object to the rule that takes it, by what its header says."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from pydicom import Dataset
from pydicom.uid import RTStructureSetStorage

from model.errors import InvalidMask
from service.adapters.dicom.derivation import MANUFACTURER
from service.adapters.dicom.masks import DRAWINGS, drawn_labels, label_names
from service.adapters.dicom.objects import tolerant
from service.adapters.pacs.configuration import Rule

#: Structures that one object may hold for a rule; each is reconstructed by itself.
MOST_STRUCTURES = 32


@dataclass(frozen=True)
class Segment:
    """One segment or region: its number, its name, and the codes of what it is."""

    number: int
    label: str
    codes: frozenset[str]


@dataclass(frozen=True)
class Match:
    """The rule that takes an object, and the structures that it means.

    Attributes:
        structures: numbers of the segments or regions of each; None for the whole object.
    """

    rule: Rule
    structures: tuple[frozenset[int] | None, ...]


def find_rule(rules: Sequence[Rule], found: Dataset, sender: str) -> Match | None:
    """The first rule whose conditions all hold; None for other objects, results of this program among them.

    Raises:
        UnreadableImage: a header that cannot be read.
        InvalidMask: more structures than are accepted.
    """
    with tolerant("object"):
        if found.get("SOPClassUID") not in DRAWINGS or found.get("Manufacturer") == MANUFACTURER:
            return None
        segments, body_part = _segments(found), str(found.get("BodyPartExamined") or "")
    for rule in rules:
        wanted = [segment for segment in segments if _means(rule, segment)]
        if wanted and _is_from(rule, sender) and _holds(rule.body_parts, body_part):
            return Match(rule, _structures(rule, frozenset(segment.number for segment in wanted), found))
    return None


def _structures(rule: Rule, wanted: frozenset[int], found: Dataset) -> tuple[frozenset[int] | None, ...]:
    """Each of several segments or regions by itself, left and right for instance; those that draw nothing do not count.

    Raises:
        InvalidMask: more than are accepted.
    """
    drawn = wanted & drawn_labels(found, "object") if len(wanted) > 1 else wanted
    if len(drawn) > MOST_STRUCTURES:
        raise InvalidMask(
            f"The object has {len(drawn)} segments or regions that the rule takes; {MOST_STRUCTURES} are accepted.",
            part="object",
        )
    if len(drawn) > 1:
        return tuple(frozenset([number]) for number in sorted(drawn))
    named = bool(rule.segment_codes or rule.segment_labels)
    return ((drawn or wanted) if named else None,)


def _segments(found: Dataset) -> list[Segment]:
    names, coded = label_names(found, "object"), _coded(found)
    return [Segment(number, name, coded.get(number, frozenset())) for number, name in names.items()]


def _coded(found: Dataset) -> dict[int, frozenset[str]]:
    """Codes of the segments or regions by number; a region has those of all observations of it (PS3.3, C.8.8.8)."""
    number = "SegmentNumber"
    names: tuple[str, ...] = ("SegmentedPropertyTypeCodeSequence", "AnatomicRegionSequence")
    if found.SOPClassUID == RTStructureSetStorage:
        items = found.get("RTROIObservationsSequence") or []
        number, names = "ReferencedROINumber", ("RTROIIdentificationCodeSequence",)
    else:
        items = found.SegmentSequence
    coded: defaultdict[int, frozenset[str]] = defaultdict(frozenset)
    for item in items:
        coded[int(item[number].value)] |= frozenset[str]().union(*(_codes(item, name) for name in names))
    return coded


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
