"""Limits on images that come from outside, kept before anything of their size is in memory.

Headers are read from the first kilobytes. The number of voxels that they claim is checked with
integers that cannot overflow, and compressed voxels are inflated no further than the claim.
"""

import io
import math
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float, Shaped

from model.errors import InvalidMask, TooLarge, UnreadableImage
from model.geometry import ras_to
from service.adapters.inflating import Readable, inflating

#: Bytes of an image: held, on disk, or an open binary file that can seek.
Source = bytes | Path | BinaryIO
#: Longest text header that is read.
HEADER_LIMIT = 1 << 20
#: Most axes that an image may claim, as in NIfTI; those beyond the third have one voxel.
MAX_AXES = 7
#: Bytes beyond the claimed voxels that are tolerated (padding).
TRAILING_LIMIT = 1 << 16
#: From LPS to RAS mm, and back.
LPS_TO_RAS = np.diag([*np.diag(ras_to("LPS")), 1.0])
#: Bytes inflated at a time.
CHUNK = 1 << 20


@dataclass(frozen=True)
class ImageLimits:
    """What one image may cost.

    Attributes:
        max_bytes: as sent, compressed or not.
        max_voxels: after decompression, over all axes.
    """

    max_bytes: int
    max_voxels: int


@dataclass(frozen=True)
class Volume:
    """Voxel values and where they lie.

    Attributes:
        values: any number of axes.
        affine: (4, 4) from voxel index to world RAS mm, as the header says it, unchecked.
        oriented: whether the header declares the directions of the axes.
    """

    values: Shaped[np.ndarray, "..."]
    affine: Float[np.ndarray, "4 4"]
    oriented: bool = True


@contextmanager
def opened(source: Source, part: str, limits: ImageLimits) -> Iterator[BinaryIO]:
    """The source as a binary file at its start.

    Raises:
        TooLarge: over ``max_bytes``.
    """
    if isinstance(source, bytes):
        source = io.BytesIO(source)
    if isinstance(source, Path):
        with source.open("rb") as file:
            yield _measured(file, part, limits)
    else:
        yield _measured(source, part, limits)


def _measured(file: BinaryIO, part: str, limits: ImageLimits) -> BinaryIO:
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    if size > limits.max_bytes:
        raise TooLarge(f"{part} is larger than {limits.max_bytes} bytes, the most that is accepted", part=part)
    return file


def checked_shape(shape: Sequence[int], part: str, limits: ImageLimits) -> tuple[int, ...]:
    """The shape a header claims, as exact integers.

    Raises:
        InvalidMask: more than `MAX_AXES` axes.
        UnreadableImage: an axis without voxels.
        TooLarge: over ``max_voxels``.
    """
    if len(shape) > MAX_AXES:
        raise InvalidMask(f"{part} has more than {MAX_AXES} dimensions; a 3-D mask is accepted", part=part)
    exact = tuple(int(extent) for extent in shape)
    if not exact or min(exact) < 1:
        raise UnreadableImage(
            f"{part} claims an axis without voxels; at least one along each axis is needed", part=part
        )
    if math.prod(exact) > limits.max_voxels:
        raise TooLarge(f"{part} claims more than {limits.max_voxels} voxels, the most that is accepted", part=part)
    return exact


def checked_dimensions(shape: tuple[int, ...], part: str) -> None:
    """Refuse what cannot be a 3-D mask before its voxels are read.

    Raises:
        InvalidMask: not three axes, apart from trailing ones of length one.
    """
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3:
        raise InvalidMask(f"{part} has {len(shape)} dimensions; a 3-D mask is accepted", part=part)


def inflated(file: BinaryIO, encoding: str, size: int, part: str) -> Iterator[bytes]:
    """Exactly the claimed number of bytes, from the file's position on, decompressed, some at a time.

    Args:
        encoding: ``raw``, ``gzip``, ``zlib`` or ``bzip2``.
        size: bytes that the header claims.

    Raises:
        UnreadableImage: fewer bytes than claimed, or a damaged stream.
        TooLarge: more than `TRAILING_LIMIT` bytes beyond the claim, as a decompression bomb has.
    """
    read = 0
    try:
        for piece in _read_at_most(inflating(file, encoding), size + TRAILING_LIMIT + 1):
            yield piece[: max(0, size - read)]
            read += len(piece)
    except (OSError, EOFError, zlib.error) as error:
        raise UnreadableImage(
            f"{part} is damaged or ends too early; a complete image is accepted", part=part
        ) from error
    if read < size:
        raise UnreadableImage(f"{part} ends before its last voxel; a complete image is accepted", part=part)
    if read > size + TRAILING_LIMIT:
        raise TooLarge(
            f"{part} holds more data than its header claims; only the claimed voxels are accepted", part=part
        )


def inflated_head(file: BinaryIO, size: int) -> bytes:
    """The first bytes of a gzip file, inflated: at most so many, and none where they are damaged."""
    file.seek(0)
    try:
        return b"".join(_read_at_most(inflating(file, "gzip"), size))
    except (OSError, EOFError, zlib.error):
        return b""


def _read_at_most(stream: Readable, limit: int) -> Iterator[bytes]:
    left = limit
    while left > 0 and (piece := stream.read(min(CHUNK, left))):
        left -= len(piece)
        yield piece
