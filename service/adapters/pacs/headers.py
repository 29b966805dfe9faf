"""What an object is, found before any more of it is read: its class, its own UIDs, its study."""

import io
from dataclasses import dataclass

from pydicom import Dataset, dcmread
from pydicom.filereader import read_dataset, read_preamble
from pydicom.uid import DeflatedExplicitVRLittleEndian

from model.errors import UnreadableImage
from service.adapters.dicom.derivation import MANUFACTURER
from service.adapters.dicom.masks import DRAWINGS
from service.adapters.dicom.objects import tolerant

_NAMES = ["SOPClassUID", "SOPInstanceUID", "StudyInstanceUID", "Manufacturer"]


@dataclass(frozen=True)
class Header:
    """UIDs of an object, each empty where it cannot be read.

    Attributes:
        is_foreign: whether it is certainly no drawing, or a result of this program.
    """

    sop_class: str
    sop_instance: str
    study: str
    is_foreign: bool


def header_of(data: bytes) -> Header:
    """The header of a file in any transfer syntax; what cannot be read is no error here."""
    meta = _meta_of(data)
    found = _data_set_of(data, meta)
    classes = {str(found.get("SOPClassUID") or ""), str(meta.get("MediaStorageSOPClassUID") or "")} - {""}
    is_own = found.get("Manufacturer") == MANUFACTURER
    return Header(
        str(found.get("SOPClassUID") or meta.get("MediaStorageSOPClassUID") or ""),
        str(found.get("SOPInstanceUID") or meta.get("MediaStorageSOPInstanceUID") or ""),
        str(found.get("StudyInstanceUID") or ""),
        bool(classes) and (is_own or classes.isdisjoint(DRAWINGS)),
    )


def _meta_of(data: bytes) -> Dataset:
    try:
        with tolerant("object"):
            file = io.BytesIO(data)
            read_preamble(file, force=True)
            meta = read_dataset(file, False, True, stop_when=lambda tag, vr, length: tag.group != 2)
            for name in ("MediaStorageSOPClassUID", "MediaStorageSOPInstanceUID", "TransferSyntaxUID"):
                meta.get(name)  # values are parsed when they are first looked at
            return meta
    except UnreadableImage:
        return Dataset()


def _data_set_of(data: bytes, meta: Dataset) -> Dataset:
    """Nothing of a deflated one: it would be inflated before its size is known."""
    if meta.get("TransferSyntaxUID") == DeflatedExplicitVRLittleEndian:
        return Dataset()
    try:
        with tolerant("object"):
            found = dcmread(io.BytesIO(data), stop_before_pixels=True, force=True, specific_tags=_NAMES)
            for name in _NAMES:
                found.get(name)
            return found
    except UnreadableImage:
        return Dataset()
