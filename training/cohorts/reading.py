"""One mask file to voxels and grid: NIfTI through nibabel, NRRD and MetaImage through SimpleITK."""

import zlib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import SimpleITK as sitk
from jaxtyping import Bool, Float, Int, Shaped
from nibabel.filebasedimages import ImageFileError
from nibabel.spatialimages import HeaderDataError

from model.errors import InvalidMask, UnreadableImage
from model.geometry import Grid
from model.inference.stacks import checked_affine, make_stack

SUFFIXES = (".nii.gz", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd")
#: The readers' own errors for a file that is damaged, cut short or of another kind.
READ_ERRORS = (ImageFileError, HeaderDataError, OSError, EOFError, RuntimeError, ValueError, zlib.error)


@dataclass(frozen=True)
class MaskFile:
    """What a file holds: voxels of the object, their grid (RAS mm) and what was peculiar."""

    mask: Bool[np.ndarray, "i j k"]
    grid: Grid
    findings: tuple[str, ...] = ()


@dataclass(frozen=True)
class LabelFile:
    """Whole numbers of a label map, their grid (RAS mm) and what was peculiar."""

    labels: Int[np.ndarray, "i j k"]
    grid: Grid
    findings: tuple[str, ...] = ()


def stem(path: Path) -> str:
    """File name without any image suffix."""
    suffix = next((known for known in SUFFIXES if path.name.lower().endswith(known)), path.suffix)
    return path.name[: len(path.name) - len(suffix)]


def is_mask_file(path: Path) -> bool:
    """Whether the suffix is one that `read_mask` takes."""
    return path.name.lower().endswith(SUFFIXES) and not path.name.startswith(".")


def read_mask(path: Path, labels: Collection[int] = ()) -> MaskFile:
    """Voxels that carry one of the labels (any non-zero one when none are named), checked as requests are.

    Raises:
        UnreadableImage: not an image, or one that ends too early.
        InvalidGeometry: an affine that no voxel grid can have.
        InvalidMask: no volume, values that are no labels, no foreground, or voxels that nobody looked at.
        InvalidParameter: a label that no object can have.
    """
    name = stem(path)
    values, affine, findings = _read(path)
    stack = make_stack("the mask", values, affine, frozenset(labels) or None)
    if stack.excluded.any():
        raise InvalidMask(
            "the mask has voxels that nobody looked at (255); dense masks are accepted for training", part=name
        )
    return MaskFile(stack.foreground, stack.grid, findings)


def read_labels(path: Path) -> LabelFile:
    """A label map of many objects.

    Raises:
        UnreadableImage: not an image, or one that ends too early.
        InvalidGeometry: an affine that no voxel grid can have.
        InvalidMask: no volume, or values that are no labels.
    """
    values, affine, findings = _read(path)
    whole = np.asarray(values).squeeze()
    if whole.ndim != 3 or not np.array_equal(whole, np.rint(whole)):
        raise InvalidMask("the file is no volume of whole numbers; a label map is accepted", part=stem(path))
    grid = Grid((whole.shape[0], whole.shape[1], whole.shape[2]), checked_affine("the mask", affine))
    return LabelFile(whole.astype(np.int32), grid, findings)


def _read(path: Path) -> tuple[Shaped[np.ndarray, "..."], Float[np.ndarray, "4 4"], tuple[str, ...]]:
    nifti = path.name.lower().endswith((".nii", ".nii.gz"))
    try:
        return _read_nifti(path) if nifti else _read_with_itk(path)
    except READ_ERRORS as error:
        raise UnreadableImage(
            "the file cannot be read; a complete NIfTI, NRRD or MetaImage is accepted", part=stem(path)
        ) from error


def _read_nifti(path: Path) -> tuple[Shaped[np.ndarray, "..."], Float[np.ndarray, "4 4"], tuple[str, ...]]:
    library: Any = nib
    image = library.load(path)
    values = np.asarray(image.dataobj)
    stated = int(image.header["sform_code"]) > 0 or int(image.header["qform_code"]) > 0
    findings = () if stated else ("the header states no orientation, left and right may be exchanged",)
    return values, np.asarray(image.affine, float), findings


def _read_with_itk(path: Path) -> tuple[Shaped[np.ndarray, "..."], Float[np.ndarray, "4 4"], tuple[str, ...]]:
    library: Any = sitk
    image = library.ReadImage(str(path))
    size = image.GetDimension()
    linear = np.reshape(image.GetDirection(), (size, size)) * np.asarray(image.GetSpacing())
    affine = np.eye(4)
    affine[:3, :3][:size, :size] = linear[:3, :3]
    affine[:3, 3][:size] = image.GetOrigin()[:3]
    return library.GetArrayFromImage(image).T, np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine, ()
