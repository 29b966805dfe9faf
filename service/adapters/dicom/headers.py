"""Headers of images as results carry them over: in one character set, and with values that hold.

Scanners and archives write headers that are not quite the standard's. What results take from them is mended where it
is clear what was meant, and emptied where the standard lets it be empty (type 2). What says whose images these are
(identifiers, names) is never changed.
"""

import re
from collections.abc import Callable, Sequence
from datetime import date, time
from math import isfinite
from typing import Any

from pydicom import DataElement, Dataset
from pydicom.charset import python_encoding
from pydicom.datadict import dictionary_description, tag_for_keyword
from pydicom.multival import MultiValue
from pydicom.sequence import Sequence as Items
from pydicom.tag import Tag
from pydicom.valuerep import DSfloat

from model.errors import InputError
from model.geometry import Grid
from service.adapters.quiet import quiet

#: Elements of patient and study that every image has to have, if without a value (type 2; PS3.3, C.7.1.1 and C.7.2.1).
COMMON = (
    *("PatientName", "PatientID", "PatientBirthDate", "PatientSex"),
    *("AccessionNumber", "StudyID", "StudyDate", "StudyTime", "ReferringPhysicianName"),
)
#: Elements without whose value nothing can be said to belong to the image (type 1).
NEEDED = ("SOPClassUID", "SOPInstanceUID", "StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID")
#: Unicode in UTF-8 (PS3.3, C.12.1.1.2): has the characters of all other sets.
CHARACTER_SET = "ISO_IR 192"
#: Elements whose value all images of a series share.
SHARED = ("StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID", "Rows", "Columns")
#: Values of Patient's Sex.
SEXES = ("M", "F", "O")

#: Stands for what a character set cannot spell.
REPLACEMENT = "\N{REPLACEMENT CHARACTER}"

_CHARACTER_SET_TAG = Tag(0x00080005)
_DATE = re.compile(r"(\d{4})([.\-/]?)(\d\d)\2(\d\d)")
_TIME = re.compile(r"(\d\d)(?:(:?)(\d\d)(?:\2(\d\d)(\.\d{1,6})?)?)?")
_AGE = re.compile(r"\d{3}[DWMY]")
_KNOWN_TERMS = {re.sub(r"[ _-]+", " ", term.upper()) for term in python_encoding}
#: What a damaged value raises when it is decoded.
_FAULTS = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError)


def completed(images: Sequence[Dataset], grid: Grid, part: str) -> tuple[Dataset, ...]:
    """Copies of images that lie on a grid, with every element that objects derived from them must carry over.

    Text is Unicode (`CHARACTER_SET`), however the headers were read. Dates and times of old forms are of today's
    form, those that are none are empty. What is absent of patient and study is empty. The distance of the planes is
    that of their positions, whatever the images say of it; the slice thickness is the same where the images give none.
    The frames' directions and spacing are said once for all.
    Pixels, and a file's meta information, are shared with the images.

    Raises:
        InputError: an identifier is lacking, an element of patient or study has several values or cannot be spelt,
            or images differ in what all of a series share.
    """
    with quiet():
        found = tuple(_in_unicode(image) for image in images)
        for image, source in zip(found, images, strict=True):
            if hasattr(source, "file_meta"):
                image.file_meta = source.file_meta
            image.SpecificCharacterSet = CHARACTER_SET
            _complete(image, part)
            _require_spelling(image, source, part)
            _share_groups(image)
            _give_distances(image, grid)
            if "ImageOrientationPatient" in found[0]:
                image.ImageOrientationPatient = found[0].ImageOrientationPatient
    for name in SHARED:
        if len({str(image.get(name)) for image in found}) > 1:
            raise InputError(
                f"The {part} has images with different values in {_named(name)}; the same in all is accepted", part=part
            )
    return found


def _complete(image: Dataset, part: str) -> None:
    for name in NEEDED:
        if not image.get(name) or isinstance(image[name].value, MultiValue):
            raise InputError(
                f"The {part} has an image without a usable {_named(name)}; one UID is accepted there", part=part
            )
    for name in COMMON:
        if name not in image:
            setattr(image, name, None)
        elif isinstance(image[name].value, MultiValue):
            raise InputError(
                f"The {part} has an image with several values in {_named(name)}; one or none is accepted there",
                part=part,
            )


def _require_spelling(image: Dataset, source: Dataset, part: str) -> None:
    """Refuse names and numbers that were decoded by a guess: `InputError`."""
    terms = source.get("SpecificCharacterSet") or ""
    known = {_term(term) for term in ([terms] if isinstance(terms, str) else terms)} <= _KNOWN_TERMS
    for name in COMMON:
        text = str(image[name].value or "")
        if REPLACEMENT in text or not (known or text.isascii()):
            raise InputError(
                f"The {part} has an image whose {_named(name)} is not in its character set; a text in that set, which "
                f"{_named('SpecificCharacterSet')} names by a term of the standard, is accepted",
                part=part,
            )


def _term(text: str) -> str:
    return re.sub(r"[ _-]+", " ", text.strip().upper())


def _named(keyword: str) -> str:
    tag = Tag(tag_for_keyword(keyword) or 0)
    return f"{keyword} ({tag.group:04X},{tag.element:04X}), {dictionary_description(tag)}"


def _in_unicode(found: Dataset) -> Dataset:
    """A copy whose text is decoded, down to the items of sequences; values that cannot be decoded are left out."""
    copy = Dataset()
    for tag in found.keys():  # noqa: SIM118 - iterating decodes, and one damaged value would end it
        try:
            element = found[tag]
            if tag != _CHARACTER_SET_TAG:
                copy.add(_mended(element))
        except _FAULTS:
            continue
    return copy


def _mended(element: DataElement) -> DataElement:
    if element.VR == "SQ":
        return DataElement(element.tag, "SQ", Items([_in_unicode(item) for item in element.value]))
    mend = _sex if element.keyword == "PatientSex" else _MENDED.get(element.VR)
    return element if mend is None else DataElement(element.tag, element.VR, _each(element.value, mend))


def _each(value: Any, mend: Callable[[str], str]) -> Any:
    if isinstance(value, MultiValue):
        return [mend(str(item)) for item in value]
    return None if value is None else mend(str(value))


def _date(text: str) -> str:
    """A date as YYYYMMDD from that, or with `.` (before 1993), `-` or `/` between; empty when it is none."""
    match = _DATE.fullmatch(text.strip())
    try:
        return date(*map(int, match.group(1, 3, 4))).isoformat().replace("-", "") if match else ""
    except ValueError:
        return ""


def _time(text: str) -> str:
    """A time as HH, HHMM or HHMMSS with a fraction, from that or with `:` between; empty when it is none."""
    match = _TIME.fullmatch(text.strip())
    if match is None:
        return ""
    hour, _, minute, second, fraction = match.groups()
    try:
        time(int(hour), int(minute or 0), 59 if second == "60" else int(second or 0))
    except ValueError:
        return ""
    return f"{hour}{minute or ''}{second or ''}{fraction or ''}"


def _age(text: str) -> str:
    return text.strip() if _AGE.fullmatch(text.strip()) else ""


def _sex(text: str) -> str:
    return text.strip().upper() if text.strip().upper() in SEXES else ""


#: Ways to mend values, by value representation. A name is spelt anew, so that it is written in the new character set.
_MENDED: dict[str, Callable[[str], str]] = {"DA": _date, "TM": _time, "AS": _age, "PN": str}


def _share_groups(image: Dataset) -> None:
    """Directions and spacing of all frames from the first one, where a multi-frame image repeats them in each."""
    frames = image.get("PerFrameFunctionalGroupsSequence")
    if not frames:
        return
    if not image.get("SharedFunctionalGroupsSequence"):
        image.SharedFunctionalGroupsSequence = Items([Dataset()])
    shared = image.SharedFunctionalGroupsSequence[0]
    for name in ("PlaneOrientationSequence", "PixelMeasuresSequence"):
        if name not in shared and name in frames[0]:
            setattr(shared, name, frames[0][name].value)


def _give_distances(image: Dataset, grid: Grid) -> None:
    """The distance of the planes, and as slice thickness where there is none (type 1C in what is derived)."""
    shared = image.get("SharedFunctionalGroupsSequence")
    measures = shared[0].get("PixelMeasuresSequence") if shared else None
    holder = measures[0] if measures else image
    distance = DSfloat(float(f"{grid.spacing[2]:.6g}"), auto_format=True)
    holder.add_new(Tag(0x00180088), "DS", distance)
    thickness = holder.get("SliceThickness")
    if not isinstance(thickness, int | float) or not isfinite(thickness) or thickness <= 0:
        holder.add_new(Tag(0x00180050), "DS", distance)
