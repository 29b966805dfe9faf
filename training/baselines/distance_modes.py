"""Principal modes of clipped signed-distance fields: the classical implicit shape model.

After Leventon, Grimson and Faugeras (CVPR 2000): shapes are described by the mean of their signed distances on one
canonical grid and by its principal components.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from model.geometry import Grid


@dataclass(frozen=True)
class DistanceModes:
    """Mean field and modes on a canonical grid (RAS mm, the shapes' centroid at the origin); v is its voxel count.

    Attributes:
        grid: the canonical grid, its axes along the world's.
        mean: (v,) mean signed distance (mm), positive inside, last index fastest.
        modes: (v, k) mm a standard deviation, the largest first.
        shares: (k,) share of the variance that the modes up to each explain.
        clip_mm: where the distances were clipped.
    """

    grid: Grid
    mean: Float[np.ndarray, "v"]
    modes: Float[np.ndarray, "v k"]
    shares: Float[np.ndarray, "k"]
    clip_mm: float

    def reduced(self, share: float) -> "DistanceModes":
        """The fewest leading modes that explain this share of the variance; all when they do not reach it."""
        count = min(int(np.searchsorted(self.shares, share)) + 1, len(self.shares))
        return DistanceModes(
            self.grid, self.mean, np.ascontiguousarray(self.modes[:, :count]), self.shares[:count], self.clip_mm
        )

    def field(self, coefficients: Float[np.ndarray, "k"]) -> Float[np.ndarray, "v"]:
        """Signed distance (mm) of a shape on the canonical grid."""
        return np.asarray(self.mean + self.modes @ coefficients.astype(self.modes.dtype))

    def save(self, path: Path) -> None:
        """Write to an ``.npz`` file; `load` is its inverse."""
        path.parent.mkdir(parents=True, exist_ok=True)
        shape, affine = np.array(self.grid.shape), self.grid.affine
        with path.open("wb") as stream:
            np.savez(
                stream,
                shape=shape,
                affine=affine,
                mean=self.mean,
                modes=self.modes,
                shares=self.shares,
                clip_mm=np.float64(self.clip_mm),
            )

    @classmethod
    def load(cls, path: Path) -> "DistanceModes":
        """Read what `save` wrote."""
        with np.load(path, allow_pickle=False) as stored:
            a, b, c = (int(size) for size in stored["shape"])
            grid = Grid((a, b, c), stored["affine"])
            return cls(grid, stored["mean"], stored["modes"], stored["shares"], float(stored["clip_mm"]))


def sampled(
    values: Float[np.ndarray, "v m"], combination: Float[np.ndarray, "m"], grid: Grid, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n 3"]]:
    """Trilinear values at canonical points (mm), constant beyond the grid.

    Args:
        values: fields on the grid.
        combination: weights of the fields.

    Returns:
        each field's value, and the gradient (per mm) of their weighted sum.
    """
    corner, share, scale = _cells(grid, points)
    strides = np.array([grid.shape[1] * grid.shape[2], grid.shape[2], 1])
    first = corner @ strides
    found = np.zeros((len(points), values.shape[1]), values.dtype)
    slope = np.zeros((len(points), 3))
    for offset in np.ndindex(2, 2, 2):
        at = values[first + int(np.array(offset) @ strides)]
        factors = np.where(np.array(offset) == 1, share, 1.0 - share)
        found += factors.prod(axis=1).astype(values.dtype)[:, None] * at
        others = np.stack([factors[:, 1] * factors[:, 2], factors[:, 0] * factors[:, 2], factors[:, 0] * factors[:, 1]])
        slope += ((2 * np.array(offset) - 1)[:, None] * others * (at @ combination.astype(values.dtype))).T * scale
    return found, slope


def _cells(
    grid: Grid, points: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Lowest corner of each point's cell, its place therein (0 to 1), and index per mm (0 beyond the grid)."""
    last = np.array(grid.shape) - 1
    index = grid.to_index(points)
    clamped = np.clip(index, 0, last)
    corner = np.minimum(np.floor(clamped).astype(int), last - 1)
    scale = np.where(index == clamped, 1.0 / grid.spacing, 0.0)
    return corner, clamped - corner, scale
