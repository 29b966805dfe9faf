"""MetaImage with its voxels in the same file (.mha).

The header is a list of ``key = value`` lines that ends with ``ElementDataFile = LOCAL``; its world is LPS,
and row ``n`` of ``TransformMatrix`` is the direction of axis ``n``.
"""

import re
from typing import BinaryIO

import numpy as np
from jaxtyping import Float

from model.errors import InvalidGeometry, InvalidMask, UnreadableImage
from service.adapters.image_guard import (
    HEADER_LIMIT,
    LPS_TO_RAS,
    ImageLimits,
    Volume,
    checked_dimensions,
    checked_shape,
)
from service.adapters.voxels import Stored, read_voxels

VOXEL_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}
#: Keys that mean the same.
SYNONYMS = {
    "Position": "Offset",
    "Origin": "Offset",
    "Rotation": "TransformMatrix",
    "Orientation": "TransformMatrix",
    "BinaryDataByteOrderMSB": "ElementByteOrderMSB",
}
_FIRST_LINE = re.compile(rb"\s*(ObjectType|NDims|Comment|ObjectSubType)\s*=", re.ASCII)


def is_metaimage(head: bytes) -> bool:
    """Whether the first bytes begin a MetaImage header."""
    return _FIRST_LINE.match(head) is not None


def read_metaimage(file: BinaryIO, part: str, limits: ImageLimits) -> Volume:
    """Values and affine.

    Raises:
        UnreadableImage: voxels in another file, a damaged header, or fewer voxels than it claims.
        TooLarge: more voxels than accepted, or more data than claimed.
        InvalidMask: not 3-D, or several channels.
        InvalidGeometry: no spacing.
    """
    fields = _header(file, part)
    if fields.get("ElementDataFile", "").upper() != "LOCAL":
        raise UnreadableImage(
            f"{part} keeps its voxels in another file; a MetaImage with them in the same file (.mha) is accepted",
            part=part,
        )
    shape = _shape(fields, part, limits)
    affine = _affine(fields, len(shape), part)
    order = ">" if _is_true(fields, "ElementByteOrderMSB") else "<"
    if fields.get("ElementType") not in VOXEL_TYPES or not _is_true(fields, "BinaryData", "True"):
        raise UnreadableImage(f"{part} has voxels of an unknown type; binary numbers are accepted", part=part)
    kind = np.dtype(order + VOXEL_TYPES[fields["ElementType"]])
    encoding = "zlib" if _is_true(fields, "CompressedData") else "raw"
    values = read_voxels(file, Stored(encoding, kind, shape), part, limits)
    return Volume(values, affine, oriented="TransformMatrix" in fields)


def _header(file: BinaryIO, part: str) -> dict[str, str]:
    """Fields by name; leaves the file where the voxels begin."""
    file.seek(0)
    fields: dict[str, str] = {}
    while file.tell() < HEADER_LIMIT and (line := file.readline(HEADER_LIMIT)):
        key, sign, value = line.decode("latin-1").partition("=")
        if not sign:
            break
        fields.setdefault(SYNONYMS.get(key.strip(), key.strip()), value.strip())
        if key.strip() == "ElementDataFile":
            return fields
    raise _damaged(part)


def _damaged(part: str) -> UnreadableImage:
    return UnreadableImage(f"{part} has a damaged MetaImage header; a complete .mha file is accepted", part=part)


def _is_true(fields: dict[str, str], key: str, default: str = "False") -> bool:
    return fields.get(key, default).lower() in ("true", "1")


def _shape(fields: dict[str, str], part: str, limits: ImageLimits) -> tuple[int, ...]:
    try:
        extents = [int(word) for word in fields["DimSize"].split()]
        axes = int(fields["NDims"])
    except (KeyError, ValueError) as error:
        raise _damaged(part) from error
    if len(extents) != axes:
        raise _damaged(part)
    shape = checked_shape(extents, part, limits)
    checked_dimensions(shape, part)
    if fields.get("ElementNumberOfChannels", "1") != "1":
        raise InvalidMask(f"{part} has several channels; a mask with one value a voxel is accepted", part=part)
    return shape


def _affine(fields: dict[str, str], axes: int, part: str) -> Float[np.ndarray, "4 4"]:
    """Voxel index to world RAS mm; axes beyond the third, which have one voxel, are left out."""
    spacing = fields.get("ElementSpacing", fields.get("ElementSize"))
    if spacing is None:
        raise InvalidGeometry(f"{part} names no voxel spacing; an ElementSpacing in mm is needed", part=part)
    identity = " ".join(str(number) for number in np.eye(axes).ravel())
    matrix = _numbers(fields.get("TransformMatrix", identity), axes * axes, part).reshape(axes, axes)[:3, :3]
    affine = np.eye(4)
    affine[:3, :3] = matrix.T * _numbers(spacing, axes, part)[:3]
    affine[:3, 3] = _numbers(fields.get("Offset", "0 " * axes), axes, part)[:3]
    return LPS_TO_RAS @ affine


def _numbers(text: str, count: int, part: str) -> Float[np.ndarray, "n"]:
    words = text.split()
    if len(words) != count:
        raise _damaged(part)
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise _damaged(part) from error
