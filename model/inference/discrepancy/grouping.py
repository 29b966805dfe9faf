"""Points of one cell of a regular grid taken together, on plain arrays."""

import numpy as np
from jaxtyping import Float, Int


def cells_of(
    points: Float[np.ndarray, "n 3"], size_mm: float, kinds: Int[np.ndarray, "n"] | None = None
) -> Int[np.ndarray, "n"]:
    """Number of the cube that each point lies in, 0 upwards without gaps; points of different kinds share none."""
    cells = np.floor((points - points.min(axis=0)) / size_mm).astype(np.int64)
    columns = cells if kinds is None else np.column_stack([cells, kinds])
    shape = columns.max(axis=0) + 1
    _, numbers = np.unique(np.ravel_multi_index(tuple(columns.T), tuple(shape)), return_inverse=True)
    return np.asarray(numbers).ravel()


def means_of(cells: Int[np.ndarray, "n"], values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "c k"]:
    """Mean of the rows of each cell."""
    counts = np.bincount(cells)
    return np.stack([np.bincount(cells, column) / counts for column in values.T], axis=1)


def middle_of(cells: Int[np.ndarray, "n"], points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "c"]:
    """Number of each cell's point that lies nearest to the mean of all of them."""
    distances = np.square(points - means_of(cells, points)[cells]).sum(axis=1)
    order = np.lexsort((distances, cells))
    return np.asarray(order[np.flatnonzero(np.diff(cells[order], prepend=-1))])
