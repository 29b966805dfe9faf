"""NRRD with its voxels in the same file, and 3-D Slicer's segmentations (.seg.nrrd).

The declared space (RAS, LPS or LAS) is converted to RAS; a file that declares none is LPS, as ITK reads
it. A segmentation whose segments overlap has a leading axis of layers, which are laid on top of each other
(`service.adapters.nrrd_layers`).
"""

import re
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import nrrd
import numpy as np
from jaxtyping import Float, Shaped

from model.errors import InvalidGeometry, InvalidMask, UnreadableImage
from service.adapters.image_guard import (
    HEADER_LIMIT,
    LPS_TO_RAS,
    ImageLimits,
    Volume,
    checked_dimensions,
    checked_shape,
)
from service.adapters.nrrd_layers import checked_layers, layers_by_value, merged
from service.adapters.quiet import quiet
from service.adapters.voxels import Stored, read_voxels

MAGIC = b"NRRD00"
ENCODINGS = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2"}
VOXEL_TYPES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i8": ("longlong", "long long", "long long int", "signed long long", "signed long long int", "int64", "int64_t"),
    "u8": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "f4": ("float",),
    "f8": ("double",),
}
#: World directions of a declared space, as signs of RAS.
TO_RAS = {
    "right-anterior-superior": np.eye(4),
    "ras": np.eye(4),
    "left-posterior-superior": LPS_TO_RAS,
    "lps": LPS_TO_RAS,
    "left-anterior-superior": np.diag([-1.0, 1.0, 1.0, 1.0]),
    "las": np.diag([-1.0, 1.0, 1.0, 1.0]),
}
#: mm in one unit of length.
MM_PER_UNIT = {"mm": 1.0, "millimeter": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3, "micron": 1e-3}
#: Kinds of an axis that counts layers of a segmentation.
LAYER_KINDS = ("list", "vector")
#: Fields that say where the voxels are when they are in another file.
DETACHED = ("data file", "datafile")
#: Fields that are read; pynrrd takes time and memory that grow with the square of what others hold.
FIELDS = (
    *("type", "dimension", "sizes", "encoding", "endian", "kinds", "spacings"),
    *("space", "space dimension", "space directions", "space origin", "space units"),
    *("line skip", "lineskip", "byte skip", "byteskip"),
)
#: Longest of them (characters).
FIELD_LIMIT = 1 << 12
_END_OF_HEADER = re.compile(rb"\r?\n\r?\n")


def is_nrrd(head: bytes) -> bool:
    """Whether the first bytes are NRRD's."""
    return head.startswith(MAGIC)


def read_nrrd(file: BinaryIO, part: str, limits: ImageLimits, labels: frozenset[int] | None) -> Volume:
    """Values and affine; layers of a segmentation are merged.

    Args:
        labels: values that the caller will pick; all when None.

    Raises:
        UnreadableImage: voxels in another file, a damaged header, or fewer voxels than it claims.
        TooLarge: more voxels than accepted, or more data than claimed.
        InvalidMask: not 3-D, voxels that are no plain numbers, or a label of several segments in overlapping layers.
        InvalidGeometry: no spacing, or a space that is not anatomical.
    """
    header = _header(file, part)
    fields = _parsed(header, part)
    shape = checked_shape(fields.get("sizes", ()), part, limits)
    layered = _has_layers(fields, shape)
    checked_dimensions(shape[1:] if layered else shape, part)
    if layered:
        checked_layers(shape[0], part)
    affine = _affine(fields, part, first_axis=int(layered))
    values = _values(file, fields, shape, part, limits)
    if layered and values.shape == shape:
        values = merged(values, labels, layers_by_value(header.pairs), part)
    return Volume(values, affine, oriented={"space", "space directions"} <= fields.keys())


@dataclass(frozen=True)
class _Header:
    """What a header says, as it is written: its version, fields and key/value pairs."""

    version: str
    fields: dict[str, str] = field(default_factory=dict)
    pairs: dict[str, str] = field(default_factory=dict)


def _header(file: BinaryIO, part: str) -> _Header:
    """The header in front of voxels; leaves the file where they begin."""
    file.seek(0)
    head = file.read(HEADER_LIMIT)
    end = _END_OF_HEADER.search(head)
    header = _split(head[: end.start()] if end else head, part)
    if not header.fields.keys().isdisjoint(DETACHED):
        raise UnreadableImage(
            f"{part} keeps its voxels in another file; an NRRD with them in the same file is accepted", part=part
        )
    if end is None:
        raise _damaged(part)
    file.seek(end.end())
    return header


def _split(head: bytes, part: str) -> _Header:
    version, *lines = (line.decode("ascii", "ignore").rstrip() for line in head.splitlines())
    header = _Header(version)
    for line in lines:
        name, sign, value = (word.strip() for word in line.partition(":"))
        if line.startswith("#"):
            continue
        if value.startswith("="):
            header.pairs.setdefault(name, value[1:].strip())
        elif sign and name not in header.fields:
            header.fields[name] = value
        else:
            raise _damaged(part)
    return header


def _parsed(header: _Header, part: str) -> dict[str, Any]:
    known = {name: header.fields[name] for name in FIELDS if name in header.fields}
    if any(len(value) > FIELD_LIMIT for value in known.values()):
        raise UnreadableImage(
            f"{part} has an NRRD header with a field of over {FIELD_LIMIT} characters; shorter ones are accepted",
            part=part,
        )
    try:
        with quiet():
            return dict(nrrd.read_header([header.version, *(f"{name}: {value}" for name, value in known.items())]))
    except (nrrd.NRRDError, ValueError, TypeError, IndexError, OverflowError) as error:
        raise _damaged(part) from error


def _damaged(part: str) -> UnreadableImage:
    return UnreadableImage(f"{part} has a damaged NRRD header; a complete NRRD is accepted", part=part)


def _has_layers(fields: dict[str, Any], shape: tuple[int, ...]) -> bool:
    kinds = fields.get("kinds", [])
    return len(shape) == 4 and len(kinds) == 4 and kinds[0] in LAYER_KINDS


def _values(
    file: BinaryIO, fields: dict[str, Any], shape: tuple[int, ...], part: str, limits: ImageLimits
) -> Shaped[np.ndarray, "..."]:
    kind = _voxel_type(fields, part)
    encoding = ENCODINGS.get(str(fields.get("encoding")).lower())
    skips = [fields.get(key, 0) for key in ("line skip", "lineskip", "byte skip", "byteskip")]
    if any(skips):
        raise UnreadableImage(
            f"{part} skips bytes or lines before its voxels; NRRD without skips is accepted", part=part
        )
    if encoding is None:
        raise UnreadableImage(f"{part} has an unknown NRRD encoding; raw, gzip and bzip2 are accepted", part=part)
    return read_voxels(file, Stored(encoding, kind, shape), part, limits)


def _voxel_type(fields: dict[str, Any], part: str) -> np.dtype[Any]:
    name = str(fields.get("type")).lower()
    code = next((code for code, names in VOXEL_TYPES.items() if name in names), None)
    if code is None:
        raise InvalidMask(f"{part} holds voxels that are no plain numbers; integer labels are accepted", part=part)
    return np.dtype((">" if fields.get("endian") == "big" else "<") + code)


def _affine(fields: dict[str, Any], part: str, first_axis: int) -> Float[np.ndarray, "4 4"]:
    """Voxel index of the three axes from the first spatial one on to world RAS mm."""
    space = str(fields.get("space", "lps")).lower()
    if space not in TO_RAS:
        raise InvalidGeometry(
            f"{part} declares a space that is not anatomical; RAS, LPS and LAS are accepted", part=part
        )
    affine = np.eye(4)
    axes = slice(first_axis, first_axis + 3)
    try:
        if "space directions" in fields:
            directions = np.array([_row(row) for row in fields["space directions"]][axes])
            affine[:3, :3] = directions.T
        else:
            affine[:3, :3] = np.diag(np.asarray(fields["spacings"], dtype=float)[axes])
    except (KeyError, ValueError, TypeError) as error:
        raise InvalidGeometry(
            f"{part} names no voxel spacing; three space directions or spacings in mm are needed", part=part
        ) from error
    affine[:3, 3] = _origin(fields, part)
    affine[:3] *= _unit(fields, part)
    result: Float[np.ndarray, "4 4"] = TO_RAS[space] @ affine
    return result


def _row(direction: Any) -> Float[np.ndarray, "3"]:
    return np.full(3, np.nan) if direction is None else np.asarray(direction, dtype=float)


def _origin(fields: dict[str, Any], part: str) -> Float[np.ndarray, "3"]:
    try:
        origin = np.asarray(fields.get("space origin", np.zeros(3)), dtype=float)
    except (ValueError, TypeError):
        origin = np.zeros(0)
    if origin.shape != (3,):
        raise InvalidGeometry(
            f"{part} has a malformed space origin; three numbers such as (1,2,3) are needed", part=part
        )
    return origin


def _unit(fields: dict[str, Any], part: str) -> float:
    units = {str(unit).lower() for unit in fields.get("space units", ["mm"])} - {""}
    if len(units) != 1 or not units <= MM_PER_UNIT.keys():
        raise InvalidGeometry(f"{part} has an unknown unit of length; mm, cm, m and um are accepted", part=part)
    return MM_PER_UNIT[units.pop()]
