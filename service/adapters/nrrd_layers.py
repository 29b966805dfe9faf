"""Layers of a 3-D Slicer segmentation whose segments overlap, laid on top of each other.

Each layer is a label map of its own. ``SegmentN_Layer`` and ``SegmentN_LabelValue`` say which value of which layer is
segment ``N``; a value that no segment claims this way counts in every layer.
"""

import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int64, Shaped

from model.errors import InvalidMask
from model.inference.stacks import EXCLUDED_VALUE

#: Layers in which a segment has the value.
LayersByValue = Mapping[int, frozenset[int]]
#: Most layers; 3-D Slicer writes as few as its segments can do with.
MAX_LAYERS = 1 << 10
#: Voxels, counted over all layers, that are laid on top of each other at a time.
CHUNK = 1 << 20
_KEY = re.compile(r"Segment([0-9]{1,9})_(Layer|LabelValue)")
_NUMBER = re.compile(r"[0-9]{1,10}")


def layers_by_value(pairs: Mapping[str, str]) -> LayersByValue:
    """Where a header's key/value pairs place its segments; a segment without layer or value is left out."""
    segments: dict[str, dict[str, int]] = {}
    for key, value in pairs.items():
        if (named := _KEY.fullmatch(key)) and _NUMBER.fullmatch(value):
            segments.setdefault(named[1], {})[named[2]] = int(value)
    found: dict[int, set[int]] = {}
    for segment in segments.values():
        if len(segment) == 2:
            found.setdefault(segment["LabelValue"], set()).add(segment["Layer"])
    return {value: frozenset(layers) for value, layers in found.items()}


def checked_layers(count: int, part: str) -> None:
    """Refuse what cannot be layers of segments before its voxels are read.

    Raises:
        InvalidMask: over `MAX_LAYERS`.
    """
    if count > MAX_LAYERS:
        raise InvalidMask(f"{part} has more than {MAX_LAYERS} layers; a segmentation with fewer is accepted", part=part)


def merged(
    layers: Shaped[np.ndarray, "n i j k"], labels: frozenset[int] | None, placed: LayersByValue, part: str
) -> Shaped[np.ndarray, "i j k"]:
    """One label map: named labels lie over others, and voxels that were never looked at over all.

    Args:
        layers: at most `MAX_LAYERS`, first index fastest in memory.
        labels: values that the caller will pick; all when None.
        placed: see `layers_by_value`.

    Raises:
        InvalidMask: a named label is of different segments in two layers.
    """
    flat = layers.reshape(len(layers), -1, order="F")
    pick = None if labels is None else _Pick(_of_kind(sorted(labels), layers.dtype), placed, part)
    step = CHUNK // len(layers)
    pieces = [_laid_over(flat[:, at : at + step], pick) for at in range(0, flat.shape[1], step)]
    return np.concatenate(pieces).reshape(layers.shape[1:], order="F")


def _of_kind(labels: Sequence[int], kind: np.dtype[np.unsignedinteger]) -> Shaped[np.ndarray, "l"]:
    return np.array([label for label in labels if label <= np.iinfo(kind).max], kind)


def _laid_over(columns: Shaped[np.ndarray, "n m"], pick: "_Pick | None") -> Shaped[np.ndarray, "m"]:
    labels = columns.max(axis=0) if pick is None else pick.laid_over(columns)
    labels[(columns == EXCLUDED_VALUE).any(axis=0)] = EXCLUDED_VALUE
    return np.asarray(labels)


class _Pick:
    """Labels that are named, which each must mean one thing in all that is met."""

    def __init__(self, labels: Shaped[np.ndarray, "l"], placed: LayersByValue, part: str) -> None:
        layers = [placed.get(label, frozenset()) for label in labels.tolist()]
        self._labels, self._part = labels, part
        self._is_placed = np.array([bool(some) for some in layers], bool)
        self._places = np.array([layer * len(labels) + number for number, some in enumerate(layers) for layer in some])
        self._layer_of = np.full(len(labels), -1)

    def laid_over(self, columns: Shaped[np.ndarray, "n m"]) -> Shaped[np.ndarray, "m"]:
        """The named label of each voxel, or the largest other one where it has none."""
        named = np.isin(columns, self._labels)
        layer, voxel = np.nonzero(named)
        number = np.searchsorted(self._labels, columns[layer, voxel])
        place = layer * len(self._labels) + number
        meant = ~self._is_placed[number] | np.isin(place, self._places)
        self._require_one_meaning(number[meant], layer[meant])
        labels = np.where(named, 0, columns).max(axis=0)
        labels[voxel[meant]] = self._labels[number[meant]]
        return np.asarray(labels)

    def _require_one_meaning(self, number: Int64[np.ndarray, "p"], layer: Int64[np.ndarray, "p"]) -> None:
        is_new = self._layer_of[number] < 0
        self._layer_of[number[is_new]] = layer[is_new]
        other = number[self._layer_of[number] != layer]
        if other.size:
            raise InvalidMask(
                f"{self._part} uses label {self._labels[other[0]]} for different segments in overlapping layers; a "
                "segmentation in which each segment has a label of its own, or no label, is accepted",
                part=self._part,
            )
