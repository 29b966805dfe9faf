"""A study without its identifiers, by the Basic Application Level Confidentiality Profile (PS3.15, E).

The profile's table is that of the library dicom-anonymizer. UIDs are replaced by the same new ones throughout
one run, so that drawings still refer to their images. Private elements are removed. Pixels stay as they
are: names that were burnt into them are not found.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from dicomanonymizer import anonymize_dataset
from jaxtyping import UInt8
from pydicom import Dataset
from pydicom.sequence import Sequence as Items

from model.errors import InputError, InvalidMask
from model.geometry import Grid
from service.adapters.dicom.masks import DRAWINGS, referenced_series, stacks_of_object
from service.adapters.dicom.objects import is_dicom, quiet, read_object
from service.adapters.dicom.series import series_of
from service.adapters.image_guard import ImageLimits

#: Code of the profile (PS3.16, CID 7050).
PROFILE = ("113100", "DCM", "Basic Application Confidentiality Profile")


@dataclass(frozen=True)
class LabelMap:
    """What a drawing drew, on the grid of its images: 1 is the object."""

    values: UInt8[np.ndarray, "i j k"]
    grid: Grid


def read_study(folder: Path) -> Iterator[Dataset]:
    """Every DICOM object below a folder, in the order of the files' names; other files are left out.

    Raises:
        UnreadableImage: a damaged object, or in a transfer syntax that is not read.
    """
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            with path.open("rb") as file:
                if is_dicom(file.read(132)):
                    yield read_object(file, "an object of the study")


def without_identifiers(found: Dataset) -> Dataset:
    """The object after the profile, in place, with a statement that it was applied."""
    with quiet():
        _apply_profile(found)
        code = Dataset()
        code.CodeValue, code.CodingSchemeDesignator, code.CodeMeaning = PROFILE
        found.PatientIdentityRemoved, found.DeidentificationMethod = "YES", "PS3.15 Basic Profile, dicom-anonymizer"
        found.DeidentificationMethodCodeSequence = Items([code])
        if "MediaStorageSOPInstanceUID" in found.file_meta:
            found.file_meta.MediaStorageSOPInstanceUID = found.SOPInstanceUID
        for name in ("SourceApplicationEntityTitle", "ImplementationVersionName"):
            if name in found.file_meta:
                delattr(found.file_meta, name)
        found.preamble = b"\0" * 128
    return found


def _apply_profile(found: Dataset) -> None:
    """The profile on items of sequences first, which the library leaves alone, then on what holds them."""
    for element in [element for element in found if element.VR == "SQ"]:
        for item in element.value:
            _apply_profile(item)
    anonymize_dataset(found, delete_private_tags=True)


def label_maps(study: Sequence[Dataset], limits: ImageLimits) -> Iterator[LabelMap]:
    """The drawings of a study as label maps on their images' grids; those whose images are not there are left out."""
    for drawing in study:
        if drawing.get("SOPClassUID") not in DRAWINGS:
            continue
        try:
            images = [image for image in study if _is_image_of(image, drawing)]
            yield _label_map(drawing, images, limits)
        except InputError:
            continue


def _is_image_of(image: Dataset, drawing: Dataset) -> bool:
    return image.get("SOPClassUID") not in DRAWINGS and image.SeriesInstanceUID == referenced_series(drawing)


def _label_map(drawing: Dataset, images: Sequence[Dataset], limits: ImageLimits) -> LabelMap:
    grid = series_of(images).grid
    values = np.zeros(grid.shape, np.uint8)
    for stack in stacks_of_object(drawing, "drawing", limits, home=grid):
        if not stack.grid.coincides_with(grid):
            raise InvalidMask("A drawing does not lie on its images; one that does is accepted.", part="drawing")
        values |= stack.foreground.astype(np.uint8)
    return LabelMap(values, grid)
