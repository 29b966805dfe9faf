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
from pydicom.uid import PYDICOM_IMPLEMENTATION_UID, MediaStorageDirectoryStorage, RTStructureSetStorage

from model.errors import InputError, InvalidMask, UnreadableImage
from model.geometry import Grid
from model.inference.mask_stack import MaskStack
from model.inference.stacks import EXCLUDED_VALUE
from service.adapters.dicom.masks import DRAWINGS, referenced_series, stacks_by_label
from service.adapters.dicom.objects import is_dicom, read_object, tolerant
from service.adapters.dicom.profile import apply_profile
from service.adapters.dicom.series import series_of
from service.adapters.image_guard import ImageLimits

#: Code of the profile (PS3.16, CID 7050).
PROFILE = ("113100", "DCM", "Basic Application Confidentiality Profile")

#: Structures that one label map may hold: no reader takes their values for voxels that were not looked at.
MOST_VALUES = EXCLUDED_VALUE - 1


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
class Structure:
    """A segment or region in a label map.

    Attributes:
        value: of its voxels.
        number: of the segment or region in the drawing.
        meaning: that its code has; empty where it has none. What somebody called it is not told.
    """

    value: int
    number: int
    meaning: str


@dataclass(frozen=True)
class LabelMap:
    """What a drawing drew, on the grid of its images.

    Attributes:
        values: those of the structures, 0 elsewhere.
        structures: in the order of the drawing.
        drawing: path of the drawing below the study's folder.
    """

    values: UInt8[np.ndarray, "i j k"]
    grid: Grid
    structures: tuple[Structure, ...]
    drawing: str


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
        found.LongitudinalTemporalInformationModified = "REMOVED"
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


def without_pixels(content: Dataset) -> Dataset:
    """An image alone with where it lies, which is all that drawings on it ask; drawings stay whole."""
    if content.get("SOPClassUID") not in DRAWINGS and "PixelData" in content:
        del content.PixelData
    return content


def label_maps(study: Sequence[StudyFile], limits: ImageLimits) -> Iterator[LabelMap | LeftOut]:
    """Each drawing of a study as label maps on its images' grid, or why there is none.

    Segments or regions that do not overlap are the values 1, 2, ... of one label map, in the order of the drawing.
    Where two of them share a voxel, or there are more than `MOST_VALUES`, each is the value 1 of its own.
    """
    for drawing in study:
        if drawing.content.get("SOPClassUID") in DRAWINGS:
            try:
                yield from _label_maps(drawing, study, limits)
            except InputError as error:
                yield LeftOut(drawing.name, str(error))


def _label_maps(drawing: StudyFile, study: Sequence[StudyFile], limits: ImageLimits) -> list[LabelMap]:
    grid = _grid_of_images(drawing.content, study)
    meanings = coded_meanings(drawing.content)
    drawn = [
        (number, meanings.get(number, ""), _packed(stacks, grid))
        for number, stacks in stacks_by_label(drawing.content, "drawing", limits, grid)
    ]
    together = len(drawn) <= MOST_VALUES and not _overlap([bits for *_, bits in drawn])
    groups = [drawn] if together else [[one] for one in drawn]
    return [_label_map(group, grid, drawing.name) for group in groups]


def _label_map(drawn: Sequence[tuple[int, str, UInt8[np.ndarray, "n"]]], grid: Grid, name: str) -> LabelMap:
    values = np.zeros(int(np.prod(grid.shape)), np.uint8)
    for value, (*_, bits) in enumerate(drawn, 1):
        values[np.unpackbits(bits, count=values.size).astype(bool)] = value
    structures = tuple(Structure(value, number, meaning) for value, (number, meaning, _) in enumerate(drawn, 1))
    return LabelMap(values.reshape(grid.shape), grid, structures, name)


def _packed(stacks: Sequence[MaskStack], grid: Grid) -> UInt8[np.ndarray, "n"]:
    """Voxels of the grid that the stacks draw, eight in a byte.

    Raises:
        InvalidMask: a stack on another grid.
    """
    if not all(stack.grid.coincides_with(grid) for stack in stacks):
        raise InvalidMask("A drawing does not lie on its images; one that does is accepted.", part="drawing")
    return np.packbits(np.logical_or.reduce([stack.foreground for stack in stacks]))


def _overlap(masks: Sequence[UInt8[np.ndarray, "n"]]) -> bool:
    """Whether two packed masks share a voxel."""
    held = np.zeros_like(masks[0])
    for mask in masks:
        if (held & mask).any():
            return True
        held |= mask
    return False


def coded_meanings(drawing: Dataset) -> dict[int, str]:
    """What the codes of segments and regions mean, by number: their kind, and modifiers such as the side.

    Raises:
        UnreadableImage: damaged.
    """
    with tolerant("drawing"):
        if drawing.SOPClassUID == RTStructureSetStorage:
            number, name = "ReferencedROINumber", "RTROIIdentificationCodeSequence"
            items = drawing.get("RTROIObservationsSequence") or []
        else:
            number, name = "SegmentNumber", "SegmentedPropertyTypeCodeSequence"
            items = drawing.SegmentSequence
        named = [(int(item[number].value), _meaning(item, name)) for item in items]
        return {number: meaning for number, meaning in reversed(named) if meaning}


def _meaning(item: Dataset, name: str) -> str:
    """Meaning of the first code and of its modifiers (PS3.3, C.8.20.2)."""
    kinds = (item.get(name) or [])[:1]
    codes = [*kinds, *(code for kind in kinds for code in kind.get("SegmentedPropertyTypeModifierCodeSequence") or [])]
    return ", ".join(str(code.CodeMeaning) for code in codes if code.get("CodeMeaning"))


def _grid_of_images(drawing: Dataset, study: Sequence[StudyFile]) -> Grid:
    """The grid of the images that were drawn on."""
    series = referenced_series(drawing)
    found = [file.content for file in study if file.content.get("SeriesInstanceUID") == series]
    return series_of([image for image in found if image.SOPClassUID not in DRAWINGS]).grid
