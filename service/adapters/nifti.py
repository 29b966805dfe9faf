"""NIfTI-1 and NIfTI-2 in one file, plain or gzip-compressed.

World coordinates follow the sform when its code is not zero, else the qform when its code is not zero,
else spacing alone: there the header knows no orientation, and the first axis is taken to point left, the
origin to lie at the volume's centre, as nibabel does. Metres and micrometres become mm; a header that
names no unit is in mm.
"""

import gzip
from typing import Any, BinaryIO

import nibabel as nib
import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped, UInt8
from nibabel.spatialimages import HeaderDataError
from nibabel.volumeutils import apply_read_scaling

from model.errors import InvalidGeometry, InvalidMask, UnreadableImage
from model.geometry import Grid
from service.adapters.image_guard import (
    ImageLimits,
    Volume,
    checked_dimensions,
    checked_shape,
    inflated_head,
)
from service.adapters.voxels import Scaling, Stored, read_voxels

#: Bytes from which a NIfTI header can be told and read.
HEAD_SIZE = 540
#: Farthest into the file that voxels may begin (bytes); header extensions lie before.
LARGEST_OFFSET = 1 << 24
#: mm in one unit of the header's ``xyzt_units & 7``: unknown, metre, mm, micrometre.
MM_PER_UNIT = {0: 1.0, 1: 1e3, 2: 1.0, 3: 1e-3}
#: Most of the gain at a third of the time.
COMPRESSION_LEVEL = 4
GZIP_MAGIC = b"\x1f\x8b"


def nifti_head(file: BinaryIO) -> bytes:
    """The first bytes of the file, inflated when it is gzip; empty when they cannot be."""
    file.seek(0)
    head = file.read(HEAD_SIZE)
    return inflated_head(file, HEAD_SIZE) if head.startswith(GZIP_MAGIC) else head


def is_nifti(head: bytes) -> bool:
    """Whether (inflated) first bytes are a NIfTI header, of a single file or of a pair."""
    return head[344:348] in (b"n+1\0", b"ni1\0") or head[4:8] in (b"n+2\0", b"ni2\0")


def read_nifti(file: BinaryIO, part: str, limits: ImageLimits) -> Volume:
    """Values (scaled as the header says) and affine.

    Raises:
        UnreadableImage: a pair, a damaged header, or fewer voxels than it claims.
        TooLarge: more voxels than accepted, or more data than claimed.
        InvalidMask: not 3-D, or voxels that are no plain numbers.
        InvalidGeometry: zero or non-finite spacing, or a qform that is no rotation.
    """
    head = nifti_head(file)
    header = _parsed(head, part)
    shape = _shape(header, part, limits)
    kind = _voxel_type(header, part)
    affine = _affine(header, part)
    start = _voxel_start(header, part)
    scaled = _scaling(header, part)
    file.seek(0)
    zipped = file.read(2) == GZIP_MAGIC
    file.seek(0)
    stored = Stored("gzip" if zipped else "raw", kind, shape, start, scaled)
    oriented = bool(header["sform_code"] != 0 or header["qform_code"] != 0)
    return Volume(read_voxels(file, stored, part, limits), affine, oriented)


def _parsed(head: bytes, part: str) -> Any:
    second = head[4:8] in (b"n+2\0", b"ni2\0")
    if head[4:8] == b"ni2\0" or (not second and head[344:348] == b"ni1\0"):
        raise UnreadableImage(f"{part} is half of a NIfTI pair; a single-file NIfTI is accepted", part=part)
    kind: Any = nib.Nifti2Header if second else nib.Nifti1Header
    if len(head) < kind.sizeof_hdr:
        raise _damaged(part)
    try:
        return kind(head[: kind.sizeof_hdr], check=False)
    except (HeaderDataError, ValueError) as error:
        raise _damaged(part) from error


def _damaged(part: str) -> UnreadableImage:
    return UnreadableImage(f"{part} has a damaged NIfTI header; a complete single-file NIfTI is accepted", part=part)


def _shape(header: Any, part: str, limits: ImageLimits) -> tuple[int, ...]:
    axes = int(header["dim"][0])
    if not 1 <= axes <= 7:
        raise _damaged(part)
    shape = checked_shape(header["dim"][1 : axes + 1].tolist(), part, limits)
    checked_dimensions(shape, part)
    return shape


def _voxel_type(header: Any, part: str) -> np.dtype[Any]:
    try:
        kind: np.dtype[Any] = np.dtype(header.get_data_dtype())
    except (HeaderDataError, KeyError) as error:
        raise _damaged(part) from error
    if kind.kind not in "buif":
        raise InvalidMask(f"{part} holds voxels that are no plain numbers; integer labels are accepted", part=part)
    return kind


def _voxel_start(header: Any, part: str) -> int:
    first = header.sizeof_hdr + 4
    offset = float(header["vox_offset"])
    if offset == 0.0:
        return int(first)
    if not first <= offset <= LARGEST_OFFSET:
        raise _damaged(part)
    return int(offset)


def _affine(header: Any, part: str) -> Float[np.ndarray, "4 4"]:
    """Voxel index to world RAS mm, from the header as it was sent: nibabel's own repairs stay off."""
    spacing = header["pixdim"][1:4].astype(float)
    if not np.isfinite(spacing).all() or (spacing == 0.0).any():
        raise InvalidGeometry(
            f"{part} has a zero or non-finite voxel spacing; positive finite spacings are accepted", part=part
        )
    if header["pixdim"][0] not in (-1.0, 1.0):
        header["pixdim"][0] = 1.0
    try:
        affine = np.array(header.get_best_affine(), dtype=float)
    except (HeaderDataError, ValueError) as error:
        raise InvalidGeometry(
            f"{part} has an orientation that is no rotation; a unit quaternion and positive spacings are accepted",
            part=part,
        ) from error
    affine[:3] *= MM_PER_UNIT.get(int(header["xyzt_units"]) & 7, 1.0)
    return affine


def _scaling(header: Any, part: str) -> Scaling | None:
    try:
        slope, intercept = header.get_slope_inter()
    except HeaderDataError as error:
        raise _damaged(part) from error
    if slope is None or (slope, intercept) == (1.0, 0.0):
        return None

    def scaled(values: Shaped[np.ndarray, "n"]) -> Shaped[np.ndarray, "n"]:
        with np.errstate(all="ignore"):
            return np.asarray(apply_read_scaling(values, slope, intercept))

    return scaled


def write_nifti(
    values: UInt8[np.ndarray, "i j k"] | Float32[np.ndarray, "i j k"] | Bool[np.ndarray, "i j k"],
    grid: Grid,
    description: str,
) -> bytes:
    """A gzip-compressed NIfTI-1; equal input gives equal bytes.

    Args:
        values: label map, or probabilities; booleans become labels 0 and 1.
        grid: of the same shape; becomes sform and qform, both with code 1 (scanner), unit mm.
        description: at most 79 ASCII characters are kept, others are dropped.
    """
    stored = values.astype(np.uint8) if values.dtype == bool else values
    library: Any = nib
    image = library.Nifti1Image(stored, grid.affine, dtype=stored.dtype)
    image.set_sform(grid.affine, code=1)
    image.set_qform(grid.affine, code=1)
    image.header.set_xyzt_units(xyz="mm")
    image.header["descrip"] = description.encode("ascii", "ignore")[:79]
    return gzip.compress(image.to_bytes(), COMPRESSION_LEVEL, mtime=0)
