"""DICOM objects from strangers: recognised, parsed and decoded within limits (PS3.5, PS3.10).

Accepted are uncompressed little endian and RLE Lossless, whose decoder is plain Python: no native codec
meets what a stranger sent. Deflated data sets are refused, since they would be inflated before their
size is known.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import BinaryIO

import numpy as np
from jaxtyping import Bool, Shaped
from pydicom import Dataset, dcmread
from pydicom.errors import BytesLengthException, InvalidDicomError
from pydicom.pixels.utils import iter_pixels
from pydicom.uid import ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless

from model.errors import InvalidMask, TooLarge, UnreadableImage
from service.adapters.image_guard import ImageLimits, checked_shape
from service.adapters.quiet import quiet

#: Where the prefix of a file stands (PS3.10, 7.1).
PREFIX = slice(128, 132)
#: Transfer syntaxes that are read.
TRANSFER_SYNTAXES = (ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless)
#: Largest frame of RLE that is decoded: a segment may grow to 64 times what was sent.
RLE_FRAME_LIMIT = 1 << 24

_FAULTS: tuple[type[Exception], ...] = (InvalidDicomError, BytesLengthException, ValueError, LookupError, TypeError)
_FAULTS += (AttributeError, EOFError, OSError, ArithmeticError, RuntimeError, MemoryError)


def is_dicom(head: bytes) -> bool:
    """Whether the first bytes are those of a DICOM file with its preamble."""
    return head[PREFIX] == b"DICM"


def read_object(file: BinaryIO, part: str) -> Dataset:
    """The data set of a file of checked length, from its start.

    Raises:
        UnreadableImage: damaged, or in a transfer syntax that is not read.
    """
    with tolerant(part):
        file.seek(0)
        meta = dcmread(file, specific_tags=[], stop_before_pixels=True, force=True).file_meta
        if meta.get("TransferSyntaxUID") not in TRANSFER_SYNTAXES:
            raise UnreadableImage(
                f"{part} has a transfer syntax that is not read; little endian, uncompressed or RLE, is accepted",
                part=part,
            )
        file.seek(0)
        return dcmread(file)


@contextmanager
def tolerant(part: str) -> Iterator[None]:
    """Quiet about odd values; anything that a damaged object raises becomes `UnreadableImage`."""
    try:
        with quiet():
            yield
    except _FAULTS as error:
        raise UnreadableImage(f"{part} is a damaged DICOM object; a complete one is accepted", part=part) from error


def checked_frames(found: Dataset, part: str, limits: ImageLimits) -> tuple[int, int, int]:
    """Frames, rows and columns of an image whose pixels may be decoded.

    Raises:
        UnreadableImage: no pixels, or an axis without any.
        InvalidMask: several samples a pixel.
        TooLarge: over a limit.
    """
    with tolerant(part):
        claimed = (int(found.get("NumberOfFrames") or 1), int(found.Rows), int(found.Columns))
        samples, present = int(found.get("SamplesPerPixel", 1)), "PixelData" in found
        packed = found.file_meta.TransferSyntaxUID == RLELossless
    frames, rows, columns = checked_shape(claimed, part, limits)
    if not present:
        raise UnreadableImage(f"{part} holds no pixels; a complete object is accepted", part=part)
    if samples != 1:
        raise InvalidMask(f"{part} holds colours; one sample a pixel is accepted", part=part)
    if packed and rows * columns > RLE_FRAME_LIMIT:
        raise TooLarge(f"{part} has RLE frames of more than {RLE_FRAME_LIMIT} pixels, the most accepted", part=part)
    return frames, rows, columns


def frames_of(
    found: Dataset, part: str, numbers: Sequence[int] | None = None
) -> Iterator[Shaped[np.ndarray, "rows columns"]]:
    """Stored values of each frame in turn, or of those so numbered (from 0); call `checked_frames` before."""
    with tolerant(part):
        chosen = range(int(found.get("NumberOfFrames") or 1)) if numbers is None else numbers
        packed = int(found.BitsAllocated) == 1 and not found.file_meta.TransferSyntaxUID.is_compressed
        if packed:
            yield from _bits_of(found, chosen)
        elif chosen:
            yield from iter_pixels(found, raw=True, indices=chosen)


def _bits_of(found: Dataset, numbers: Sequence[int]) -> Iterator[Bool[np.ndarray, "rows columns"]]:
    """Frames of one bit a pixel; they follow each other without a gap, so one may begin within a byte (PS3.5, 8.1)."""
    size, data = found.Rows * found.Columns, found.PixelData
    for start in (size * number for number in numbers):
        held = np.frombuffer(data, np.uint8, (start + size + 7) // 8 - start // 8, start // 8)
        bits = np.unpackbits(held, bitorder="little")[start % 8 : start % 8 + size]
        yield bits.reshape(found.Rows, found.Columns).astype(bool)
