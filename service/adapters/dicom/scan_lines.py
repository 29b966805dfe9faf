"""Pixels inside a polygon, line by line: the time is that of the lines its edges cross, and of the pixels."""

import numpy as np
from jaxtyping import Bool, Float, Int

#: Crossings that are held at the same time, about.
BLOCK = 1 << 20
#: A pixel's centre that is no farther than this from the polygon (pixels) lies on it.
ON_EDGE = 1e-6


def enclosed(polygon: Float[np.ndarray, "n 2"], shape: tuple[int, int]) -> Bool[np.ndarray, "i j"]:
    """Pixels whose centres a closed polygon encloses by the even-odd rule, or has on it.

    Args:
        polygon: corners by the indices of pixels, which are at whole numbers.
        shape: of the image.
    """
    result = np.zeros(shape, bool)
    low, high = (np.clip(end, 0, shape).astype(int) for end in (polygon.min(axis=0), np.ceil(polygon.max(axis=0)) + 1))
    if (high > low).all():
        result[low[0] : high[0], low[1] : high[1]] = _enclosed(polygon - low, tuple((high - low).tolist()))
    return result


def _enclosed(polygon: Float[np.ndarray, "n 2"], shape: tuple[int, int]) -> Bool[np.ndarray, "i j"]:
    changes = np.zeros((shape[0], shape[1] + 1), np.int32)
    touched = np.zeros(shape, bool)
    starts, ends = polygon, np.roll(polygon, -1, axis=0)
    first, stop = _lines(starts[:, 0], ends[:, 0], shape[0])
    for edges in _blocks(stop - first):
        edge, line = _spread(edges, first, stop)
        share = (line - starts[edge, 0]) / (ends[edge, 0] - starts[edge, 0])
        place = starts[edge, 1] + share * (ends[edge, 1] - starts[edge, 1])
        np.add.at(changes, (line, np.clip(np.floor(place) + 1.0, 0, shape[1]).astype(int)), 1)
        _touch(touched, line, place)
    inside = np.cumsum(changes, axis=1)[:, :-1] % 2 == 1
    _touch(touched, np.rint(starts[:, 0]).astype(int), starts[:, 1], np.abs(starts[:, 0] - np.rint(starts[:, 0])))
    _touch_along(touched, starts, ends)
    return np.asarray(inside | touched)


def _lines(
    one: Float[np.ndarray, "n"], other: Float[np.ndarray, "n"], count: int
) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
    """The first line that each edge crosses, and that past the last: with its lower end on it, without its upper."""
    first, stop = (np.clip(np.ceil(side(one, other)), 0, count).astype(int) for side in (np.minimum, np.maximum))
    return first, stop


def _blocks(counts: Int[np.ndarray, "n"]) -> list[Int[np.ndarray, "m"]]:
    """Numbers of the edges that cross lines, in blocks of so many crossings."""
    edges = np.flatnonzero(counts)
    if not len(edges):
        return []
    return np.split(edges, np.flatnonzero(np.diff(np.cumsum(counts[edges]) // BLOCK)) + 1)


def _spread(
    edges: Int[np.ndarray, "m"], first: Int[np.ndarray, "n"], stop: Int[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
    """Each edge with each whole number from its first on and before its stop."""
    counts = (stop - first)[edges]
    begins = np.cumsum(counts) - counts
    return np.repeat(edges, counts), np.arange(counts.sum()) + np.repeat(first[edges] - begins, counts)


def _touch(
    touched: Bool[np.ndarray, "i j"],
    line: Int[np.ndarray, "n"],
    place: Float[np.ndarray, "n"],
    beside: Float[np.ndarray, "n"] | float = 0.0,
) -> None:
    """Mark the pixels that places on lines meet, where these are no farther than `ON_EDGE` beside the line."""
    pixel = np.rint(place)
    near = (np.abs(place - pixel) <= ON_EDGE) & (np.asarray(beside) <= ON_EDGE)
    near &= (line >= 0) & (line < touched.shape[0]) & (pixel >= 0) & (pixel < touched.shape[1])
    touched[line[near], pixel[near].astype(int)] = True


def _touch_along(
    touched: Bool[np.ndarray, "i j"], starts: Float[np.ndarray, "n 2"], ends: Float[np.ndarray, "n 2"]
) -> None:
    """Mark the pixels on edges that run along a line."""
    line = np.rint(starts[:, 0])
    along = np.maximum(np.abs(starts[:, 0] - line), np.abs(ends[:, 0] - line)) <= ON_EDGE
    along &= (line >= 0) & (line < touched.shape[0])
    first, stop = _lines(starts[along, 1], ends[along, 1], touched.shape[1])
    lines = line[along].astype(int)
    for edges in _blocks(stop - first):
        edge, pixel = _spread(edges, first, stop)
        touched[lines[edge], pixel] = True
