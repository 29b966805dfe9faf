"""Points through a network in pieces that stay in a core's cache, several cores at a time.

A layer of the decoder writes one row of activations a point. All points at once, that is tens of MB that every layer
reads from and writes to main memory; some hundreds of points stay in the second-level cache from the first layer to
the last.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from queue import Empty, SimpleQueue

import numpy as np
from jaxtyping import Float

#: Points a call of the network: measured best from 256 to 768 at a width of 128 and 1 MiB of cache.
CHUNK = 384

Array = Float[np.ndarray, "..."]
#: A network: latent (b, d) and points (b, n, 3), both float32, to outputs (b, n, ...).
Network = Callable[[Array, Array], Sequence[Array]]
_Piece = tuple[slice, slice]


class Workers:
    """Threads that share the pieces of a call; the caller's is one of them.

    Args:
        threads: how many work on one call.
    """

    def __init__(self, threads: int) -> None:
        self._others = threads - 1
        self._pool = ThreadPoolExecutor(self._others, "decoder") if self._others > 0 else None

    def evaluate(self, network: Network, latent: Array, points: Array) -> tuple[Array, ...]:
        """The network's outputs, as if it had been called with all points at once."""
        latent, points = (np.ascontiguousarray(value, np.float32) for value in (latent, points))
        pieces = _pieces(*points.shape[:2])
        if len(pieces) == 1:
            return tuple(network(latent, points))
        first, *rest = pieces
        begun = network(latent[first[0]], points[first])
        results = tuple(np.empty((*points.shape[:2], *part.shape[2:]), part.dtype) for part in begun)
        _place(results, first, begun)
        self._share(rest, lambda piece: _place(results, piece, network(latent[piece[0]], points[piece])))
        return results

    def _share(self, pieces: Sequence[_Piece], work: Callable[[_Piece], None]) -> None:
        waiting: SimpleQueue[_Piece] = SimpleQueue()
        for piece in pieces:
            waiting.put(piece)
        helpers = min(self._others, len(pieces) - 1)
        running = [self._pool.submit(_drain, waiting, work) for _ in range(helpers)] if self._pool else []
        _drain(waiting, work)
        for helper in running:
            helper.result()


def _drain(waiting: "SimpleQueue[_Piece]", work: Callable[[_Piece], None]) -> None:
    while True:
        try:
            piece = waiting.get_nowait()
        except Empty:
            return
        work(piece)


def _place(results: Sequence[Array], piece: _Piece, parts: Sequence[Array]) -> None:
    for result, part in zip(results, parts, strict=True):
        result[piece] = part


def _pieces(shapes: int, points: int) -> list[_Piece]:
    """Rows and columns of each piece: several shapes of few points each, or an equal part of one shape's points."""
    if points <= CHUNK:
        rows = max(CHUNK // max(points, 1), 1)
        return [(slice(i, i + rows), slice(None)) for i in range(0, max(shapes, 1), rows)]
    parts = -(-points // CHUNK)
    ends = [points * part // parts for part in range(parts + 1)]
    columns = [slice(a, b) for a, b in pairwise(ends)]
    return [(slice(i, i + 1), column) for i in range(shapes) for column in columns]
