"""Mask images that clients send, and label maps and probabilities that they get.

NIfTI, NRRD (3-D Slicer's segmentations too), MetaImage and DICOM are told apart by their content, never by
a file name. Sizes are checked from the header before anything of that size is in memory. World
coordinates are RAS in mm. The voxels are read here from checked headers, in bounded memory, so no
native parser meets what a stranger sent.
"""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from typing import BinaryIO, Literal

import numpy as np
from nibabel.orientations import aff2axcodes

from model.errors import UnreadableImage
from model.geometry import Grid
from model.inference.observations import MaskStack
from model.inference.stacks import checked_labels, make_stack
from service.adapters.image_guard import ImageLimits, Source, Volume, opened
from service.adapters.metaimage import is_metaimage, read_metaimage
from service.adapters.nifti import is_nifti, nifti_head, read_nifti, write_nifti
from service.adapters.nrrd_format import is_nrrd, read_nrrd

__all__ = ["ImageFormat", "ImageLimits", "Source", "image_format", "read_mask", "read_masks", "write_nifti"]

#: Where a DICOM file says that it is one (PS3.10, 7.1).
DICOM_PREFIX = slice(128, 132)

#: Where an axis points, by its letter.
_DIRECTIONS = {"L": "left", "R": "right", "P": "posterior", "A": "anterior", "I": "inferior", "S": "superior"}

ImageFormat = Literal["nifti", "nrrd", "metaimage", "dicom"]


def read_masks(
    source: Source, part: str, limits: ImageLimits, labels: frozenset[int] | None = None
) -> tuple[MaskStack, ...]:
    """The mask stacks of one file: one of an image, one for each direction of planes of a DICOM object.

    Arguments and errors are those of `read_mask`; `UnreadableImage` also when DICOM is not installed.
    """
    with opened(source, part, limits) as file:
        if image_format(file) == "dicom":
            return _dicom_reader(part)(file, part, limits, labels)
        return (read_mask(file, part, limits, labels),)


def read_mask(source: Source, part: str, limits: ImageLimits, labels: frozenset[int] | None = None) -> MaskStack:
    """A mask stack from the bytes of one image.

    Args:
        source: bytes, a path, or an open binary file that can seek (a spooled upload).
        part: how the caller knows the image in messages, for example ``mask[0]``.
        labels: the object's label values; all but 0 and 255 when None.

    Returns:
        the stack, with a note where the file declares no orientation.

    Raises:
        UnreadableImage: no NIfTI, NRRD or MetaImage, or a damaged one.
        TooLarge: over a limit.
        InvalidGeometry, InvalidMask, InvalidParameter: see `model.inference.stacks.make_stack`.
    """
    checked_labels(labels)
    # Affines from hostile headers may overflow on the way; make_stack refuses what comes of it.
    with opened(source, part, limits) as file, np.errstate(all="ignore"):
        volume = _read(file, part, limits, labels)
    stack = make_stack(part, volume.values, volume.affine, labels)
    return stack if volume.oriented else replace(stack, notes=(_orientation_note(part, stack.grid),))


def image_format(file: BinaryIO) -> ImageFormat | None:
    """Which format the content is; None for anything else. Leaves the file at its start."""
    head = file.read(512)
    file.seek(0)
    if is_nrrd(head):
        return "nrrd"
    if is_metaimage(head):
        return "metaimage"
    if head[DICOM_PREFIX] == b"DICM":
        return "dicom"
    known = is_nifti(nifti_head(file))
    file.seek(0)
    return "nifti" if known else None


def _read(file: BinaryIO, part: str, limits: ImageLimits, labels: frozenset[int] | None) -> Volume:
    found = image_format(file)
    if found == "nifti":
        return read_nifti(file, part, limits)
    if found == "nrrd":
        return read_nrrd(file, part, limits, labels)
    if found == "metaimage":
        return read_metaimage(file, part, limits)
    raise UnreadableImage(
        f"{part} is not a readable image; NIfTI, NRRD, MetaImage, DICOM SEG and RTSTRUCT in a single file are accepted",
        part=part,
    )


def _orientation_note(part: str, grid: Grid) -> str:
    """What to tell where the axes' directions are the format's convention."""
    first, second, third = (_DIRECTIONS[letter] for letter in aff2axcodes(grid.affine))
    return (
        f"{part} declares no orientation; its axes were taken to point {first}, {second} and {third}, so that left and "
        "right may be exchanged."
    )


def _dicom_reader(part: str) -> Callable[..., tuple[MaskStack, ...]]:
    """The reader of DICOM objects, which the extra ``pacs`` brings."""
    try:
        reader: Callable[..., tuple[MaskStack, ...]] = import_module("service.adapters.dicom.masks").read_dicom_mask
    except ImportError:
        raise UnreadableImage(
            f"{part} is a DICOM object, which needs the extra pacs; NIfTI, NRRD and MetaImage are accepted", part=part
        ) from None
    return reader
