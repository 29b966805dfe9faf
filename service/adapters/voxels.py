"""Voxels of a mask as integers of the smallest type that holds them, read a piece at a time.

A file may hold eight bytes for each voxel, and compress to nearly nothing; what is kept of it are labels.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Shaped, UInt

from model.errors import InvalidMask, TooLarge
from model.inference.stacks import ROUNDING_TOLERANCE
from service.adapters.image_guard import ImageLimits, inflated

#: Types of labels, the smallest first.
_TYPES = (np.uint8, np.uint16, np.uint32, np.uint64)
#: Bytes of the label of one voxel, where there are as many voxels as may be.
LABEL_BYTES = 4

#: Values as the header says they are meant.
Scaling = Callable[[Shaped[np.ndarray, "n"]], Shaped[np.ndarray, "n"]]


@dataclass(frozen=True)
class Stored:
    """How voxels lie in a file.

    Attributes:
        encoding: see `inflated`.
        kind: type of the numbers.
        shape: any number of axes, first index fastest in the file.
        start: inflated bytes before the first voxel.
        scaled: None where values are meant as they are stored.
    """

    encoding: str
    kind: np.dtype[Any]
    shape: tuple[int, ...]
    start: int = 0
    scaled: Scaling | None = None


def read_voxels(file: BinaryIO, stored: Stored, part: str, limits: ImageLimits) -> Shaped[np.ndarray, "..."]:
    """Labels in the shape that is claimed; or, as they are, some values among which one is no label.

    The latter are for `make_stack` to refuse, which says what is wrong with them.

    Raises:
        UnreadableImage: fewer voxels than claimed, or a damaged stream.
        TooLarge: more data than claimed, or labels that take more room than as many voxels as may be.
        InvalidMask: a value beyond all types of integers.
    """
    count = int(np.prod(stored.shape, dtype=object))
    labels: UInt[np.ndarray, "n"] = np.zeros(count, np.uint8)
    place = 0
    for values in _pieces(file, stored, count, part):
        integers = _integers(values)
        if integers is None:
            return values.reshape(-1, 1, 1)
        labels = _wide_enough(labels, float(integers.max(initial=0)), part, limits)
        labels[place : place + len(integers)] = integers
        place += len(integers)
    return labels.reshape(stored.shape, order="F")


def _pieces(file: BinaryIO, stored: Stored, count: int, part: str) -> Iterator[Shaped[np.ndarray, "n"]]:
    size = stored.start + count * stored.kind.itemsize
    held, skip = bytearray(), stored.start
    for piece in inflated(file, stored.encoding, size, part):
        held += piece[skip:]
        skip = max(0, skip - len(piece))
        whole = len(held) // stored.kind.itemsize
        if whole:
            values = np.frombuffer(bytes(held[: whole * stored.kind.itemsize]), stored.kind)
            del held[: whole * stored.kind.itemsize]
            yield values if stored.scaled is None else stored.scaled(values)


def _integers(values: Shaped[np.ndarray, "n"]) -> Shaped[np.ndarray, "n"] | None:
    """The labels that values stand for; None when one of them is no label."""
    if values.dtype.kind in "bu":
        return values
    rounded = values if values.dtype.kind == "i" else np.rint(values)
    if values.dtype.kind == "f" and not (np.abs(values - rounded) <= ROUNDING_TOLERANCE).all():
        return None
    return None if rounded.min(initial=0) < 0 else rounded


def _wide_enough(
    labels: UInt[np.ndarray, "n"], largest: float, part: str, limits: ImageLimits
) -> UInt[np.ndarray, "n"]:
    """The same labels in a type that holds the largest one, too."""
    if largest <= np.iinfo(labels.dtype).max:
        return labels
    kind = next((kind for kind in _TYPES if largest <= np.iinfo(kind).max and largest < 2.0**64), None)
    if kind is None:
        raise InvalidMask(f"{part} holds values that no label can have; 0 and integer labels are accepted", part=part)
    if labels.size * np.dtype(kind).itemsize > LABEL_BYTES * limits.max_voxels:
        raise TooLarge(
            f"{part} holds labels of over {8 * LABEL_BYTES} bits in more voxels than are accepted of them", part=part
        )
    return labels.astype(kind)
