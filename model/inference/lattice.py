"""Values on the nodes of a large grid, kept only in bricks around the nodes that were set."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

#: Nodes along the edge of a brick, as a power of two.
BITS = 3
_EDGE, _SIZE, _REST = 1 << BITS, 1 << 3 * BITS, (1 << BITS) - 1

#: Any number of nodes, or of cells by their first corner.
Nodes = Int[np.ndarray, "_ 3"]
Addresses = Int[np.ndarray, "..."]
#: Offsets of a cell's eight corners from its first, last axis fastest.
CORNERS: Int[np.ndarray, "8 3"] = np.stack(np.unravel_index(np.arange(8), (2, 2, 2)), axis=1)
_PAIR = (0, 1)


class SparseLattice:
    """Nodes and cells of a regular grid, of which few are in use.

    A cell has the number of its first corner. Memory is 2.5 KiB for each brick of 8 x 8 x 8 nodes that holds one in
    use, and 8 bytes for each brick of the whole grid.

    Args:
        shape: nodes along each axis.
    """

    def __init__(self, shape: Int[np.ndarray, "3"]) -> None:
        # A layer of bricks around the grid, and the first brick of all, stay without values: there nothing was set.
        self._bricks = -(-np.asarray(shape) // _EDGE) + 2
        # Of each brick of the whole grid, where its nodes stand in the storage.
        self._table = np.zeros(int(np.prod(self._bricks)), np.int64)
        self._first: Int[np.ndarray, "k 3"] = np.zeros((1, 3), np.int64)
        self._values = np.full(_SIZE, np.nan, np.float32)
        self._cells = np.zeros(_SIZE, bool)

    def values(self, nodes: Nodes) -> Float[np.ndarray, "_"]:
        """Values of nodes; NaN where none was set, and outside the grid."""
        return np.asarray(self._values[self._address(self._keys(nodes, (0,), (0,), (0,)))].reshape(-1))

    def around(self, cells: Nodes, *offsets: Sequence[int]) -> Float[np.ndarray, "i j k _"]:
        """Values at nodes of some offsets along each axis from each cell's first corner."""
        return np.asarray(self._values[self._address(self._keys(cells, *offsets))])

    def corner_values(self, cells: Nodes) -> Float[np.ndarray, "8 _"]:
        """Values at the corners of cells, in the order of `CORNERS`."""
        return self.around(cells, _PAIR, _PAIR, _PAIR).reshape(8, -1)

    def put(self, nodes: Nodes, values: Float[np.ndarray, "_"]) -> None:
        """Set values."""
        address = self._reserved(nodes, (0,))  # first: this may replace the array
        self._values[address.reshape(-1)] = values

    def add_cells(self, cells: Nodes) -> Nodes:
        """Put cells to use; returns those that were not yet, each once."""
        address = self._reserved(cells, (0,))
        mark = np.zeros(len(self._cells), bool)
        mark[address] = True
        mark &= ~self._cells
        self._cells |= mark
        return self._nodes(np.flatnonzero(mark))

    def cells(self) -> Nodes:
        """All cells in use."""
        return self._nodes(np.flatnonzero(self._cells))

    def known(self) -> tuple[Nodes, Float[np.ndarray, "_"]]:
        """All nodes that have values, and these."""
        address = np.flatnonzero(~np.isnan(self._values))
        return self._nodes(address), self._values[address]

    def unknown_corners(self, cells: Nodes) -> Nodes:
        """Corners of cells that have no value yet, each once."""
        address = self._reserved(cells, _PAIR)
        mark = np.zeros(len(self._values), bool)
        mark[address] = True
        mark &= np.isnan(self._values)
        return self._nodes(np.flatnonzero(mark))

    def _keys(self, cells: Nodes, *offsets: Sequence[int]) -> Addresses:
        """Brick of the whole grid, and place in the brick, of each offset node in one number.

        The cells come last, for sums over a long last axis are several times as fast.
        """
        key: Addresses = np.zeros(1, np.int64)
        for axis, offset in enumerate(offsets):
            shape = [-1 if other == axis else 1 for other in range(4)]
            nodes = cells[:, axis] + np.asarray(offset, np.int64).reshape(shape)
            stride = int(np.prod(self._bricks[axis + 1 :])) << 3 * BITS
            key = key + (((nodes >> BITS) + 1) * stride + ((nodes & _REST) << (2 - axis) * BITS))
        return key

    def _address(self, keys: Addresses) -> Addresses:
        address: Addresses = self._table[keys >> 3 * BITS]
        address += keys & (_SIZE - 1)
        return address

    def _reserved(self, cells: Nodes, offset: Sequence[int]) -> Addresses:
        """Place of each node in the storage, with bricks made where there were none."""
        keys = self._keys(cells, offset, offset, offset)
        bricks = keys >> 3 * BITS
        missing = bricks[self._table[bricks] == 0]
        if len(missing):
            self._grow(np.unique(missing))
        return self._address(keys)

    def _grow(self, bricks: Addresses) -> None:
        self._table[bricks] = (len(self._first) + np.arange(len(bricks))) << 3 * BITS
        first = (np.stack(np.unravel_index(bricks, tuple(self._bricks)), axis=1) - 1) * _EDGE
        self._first = np.concatenate([self._first, first])
        self._values = np.concatenate([self._values, np.full(len(bricks) * _SIZE, np.nan, np.float32)])
        self._cells = np.concatenate([self._cells, np.zeros(len(bricks) * _SIZE, bool)])

    def _nodes(self, address: Addresses) -> Nodes:
        rest = np.stack([address >> 2 * BITS & _REST, address >> BITS & _REST, address & _REST], axis=1)
        return np.asarray(self._first[address >> 3 * BITS] + rest)


def corners_of(cells: Nodes) -> Nodes:
    """The eight corners of each cell, one after the other."""
    return np.asarray((cells[:, None] + CORNERS).reshape(-1, 3))
