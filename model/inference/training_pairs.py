"""A dense label map and a few of its planes: what a network that completes sparse drawings is trained on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, UInt8

#: Label of voxels on which nobody drew.
NOT_ANNOTATED = 255
#: Fewest and most planes of a drawing.
FEWEST_PLANES, MOST_PLANES = 3, 6
#: A plane must hold this share of the largest section along its axis.
LEAST_SECTION = 0.1


@dataclass(frozen=True)
class TrainingPair:
    """A shape and a drawing of it.

    Attributes:
        dense: 1 is the object.
        sparse: the same on the planes, 255 elsewhere.
        planes: voxel axis and index of each.
    """

    dense: UInt8[np.ndarray, "i j k"]
    sparse: UInt8[np.ndarray, "i j k"]
    planes: tuple[tuple[int, int], ...]


def training_pair(dense: UInt8[np.ndarray, "i j k"], seed: int) -> TrainingPair:
    """Three to six random planes of a label map, axes and places drawn uniformly where the object is cut."""
    planes = random_planes(dense > 0, np.random.default_rng((seed, FEWEST_PLANES)))
    return TrainingPair(dense, drawn_on(dense, planes), planes)


def random_planes(foreground: Bool[np.ndarray, "i j k"], random: np.random.Generator) -> tuple[tuple[int, int], ...]:
    """Distinct planes, each with at least a tenth of the largest section along its axis, as many as there are."""
    candidates = [(axis, int(index)) for axis in range(3) for index in _cutting(foreground, axis)]
    count = int(random.integers(FEWEST_PLANES, MOST_PLANES, endpoint=True))
    axes = random.integers(0, 3, size=count)
    found: list[tuple[int, int]] = []
    for axis in axes:
        left = [plane for plane in candidates if plane[0] == axis and plane not in found]
        if left:
            found.append(left[int(random.integers(len(left)))])
    return tuple(sorted(found))


def drawn_on(dense: UInt8[np.ndarray, "i j k"], planes: Sequence[tuple[int, int]]) -> UInt8[np.ndarray, "i j k"]:
    """The label map on the planes, 255 elsewhere."""
    sparse = np.full_like(dense, NOT_ANNOTATED)
    for axis, index in planes:
        place: list[slice | int] = [slice(None)] * 3
        place[axis] = index
        sparse[tuple(place)] = dense[tuple(place)]
    return sparse


def _cutting(foreground: Bool[np.ndarray, "i j k"], axis: int) -> np.ndarray:
    sections = foreground.sum(axis=tuple(other for other in range(3) if other != axis))
    return np.flatnonzero(sections >= max(1.0, LEAST_SECTION * float(sections.max(initial=0))))
