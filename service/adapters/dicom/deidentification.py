"""A study without its identifiers, by the Basic Application Level Confidentiality Profile (PS3.15, E).

The profile's table is that of the library dicom-anonymizer; `profile` applies it. UIDs are replaced by the same new
ones throughout one run, so that drawings still refer to their images. Pixels stay as they are: names that were
burnt into them are not found.
"""

import io
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from pydicom import Dataset
from pydicom.dataset import FileMetaDataset
from pydicom.sequence import Sequence as Items
from pydicom.uid import PYDICOM_IMPLEMENTATION_UID, MediaStorageDirectoryStorage

from model.errors import InputError, InvalidMask, UnreadableImage
from model.geometry import Grid
from service.adapters.dicom.masks import DRAWINGS, referenced_series, stacks_of_object
from service.adapters.dicom.objects import is_dicom, read_object, tolerant
from service.adapters.dicom.profile import apply_profile
from service.adapters.dicom.series import series_of
from service.adapters.image_guard import ImageLimits

#: Code of the profile (PS3.16, CID 7050).
PROFILE = ("113100", "DCM", "Basic Application Confidentiality Profile")


@dataclass(frozen=True)
class StudyFile:
    """An object and the file that it was read from.

    Attributes:
        name: path below the study's folder.
    """

    name: str
    content: Dataset


@dataclass(frozen=True)
class LeftOut:
    """A file of the study, by its path below the folder, that nothing was made of, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class LabelMap:
    """What a drawing drew, on the grid of its images: 1 is the object."""

    values: UInt8[np.ndarray, "i j k"]
    grid: Grid


def read_study(folder: Path) -> Iterator[StudyFile | LeftOut]:
    """Every DICOM object below a folder, in the order of the files' names.

    Files of other formats and directories of media (DICOMDIR) are passed over. Objects that are damaged, or in a
    transfer syntax that is not read, are left out with the reason.
    """
    for path in sorted(folder.rglob("*")):
        name = os.fsencode(path.relative_to(folder)).decode(errors="replace")
        try:
            content = _read(path)
        except InputError as error:
            yield LeftOut(name, str(error))
        else:
            if content is not None:
                yield StudyFile(name, content)


def _read(path: Path) -> Dataset | None:
    with tolerant("The file"):
        if not path.is_file():
            return None
        with path.open("rb") as file:
            if not is_dicom(file.read(132)):
                return None
            found = read_object(file, "The file")
        if MediaStorageDirectoryStorage in (found.file_meta.get("MediaStorageSOPClassUID"), found.get("SOPClassUID")):
            return None
        if not found.get("SOPClassUID") or not found.get("SOPInstanceUID"):
            raise UnreadableImage(
                "The file lacks SOPClassUID (0008,0016) or SOPInstanceUID (0008,0018); objects with both are accepted",
                part="study",
            )
    return found


def without_identifiers(found: Dataset) -> Dataset:
    """The object after the profile, in place, with a statement that it was applied.

    Raises:
        UnreadableImage: a damaged value, or one of a kind that the profile has no substitute for.
    """
    with tolerant("The file"):
        apply_profile(found)
        code = Dataset()
        code.CodeValue, code.CodingSchemeDesignator, code.CodeMeaning = PROFILE
        found.PatientIdentityRemoved, found.DeidentificationMethod = "YES", "PS3.15 Basic Profile, dicom-anonymizer"
        found.DeidentificationMethodCodeSequence = Items([code])
        meta = FileMetaDataset()
        meta.FileMetaInformationVersion = b"\0\1"
        meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID = found.SOPClassUID, found.SOPInstanceUID
        meta.TransferSyntaxUID = found.file_meta.TransferSyntaxUID
        meta.ImplementationClassUID = PYDICOM_IMPLEMENTATION_UID
        found.file_meta, found.preamble = meta, b"\0" * 128
    return found


def cleared(file: StudyFile) -> bytes | LeftOut:
    """The object without identifiers as a file, in place; left out where that cannot be."""
    buffer = io.BytesIO()
    try:
        with tolerant("The file"):
            without_identifiers(file.content).save_as(buffer, enforce_file_format=True)
    except InputError as error:
        return LeftOut(file.name, str(error))
    return buffer.getvalue()


def label_maps(study: Sequence[StudyFile], limits: ImageLimits) -> Iterator[LabelMap | LeftOut]:
    """Each drawing of a study as a label map on its images' grid, or why there is none."""
    for drawing in study:
        if drawing.content.get("SOPClassUID") in DRAWINGS:
            try:
                yield _label_map(drawing.content, study, limits)
            except InputError as error:
                yield LeftOut(drawing.name, str(error))


def _label_map(drawing: Dataset, study: Sequence[StudyFile], limits: ImageLimits) -> LabelMap:
    series = referenced_series(drawing)
    found = [file.content for file in study if file.content.get("SeriesInstanceUID") == series]
    grid = series_of([image for image in found if image.SOPClassUID not in DRAWINGS]).grid
    values = np.zeros(grid.shape, np.uint8)
    for stack in stacks_of_object(drawing, "drawing", limits, home=grid):
        if not stack.grid.coincides_with(grid):
            raise InvalidMask("A drawing does not lie on its images; one that does is accepted.", part="drawing")
        values |= stack.foreground.astype(np.uint8)
    return LabelMap(values, grid)
