"""Covariance of a stationary, isotropic Gaussian process: a sum of squared exponentials.

    k(x, x') = sum_j sd_j^2 exp(-|x - x'|^2 / (2 length_j^2))

Several lengths make one process that is both locally rough and correlated far (Rasmussen and Williams 2006, section
4.2). Each term is a product over the axes, so that its sums over points on a whole lattice are matrix products.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Axes = tuple[Float[np.ndarray, "i"], Float[np.ndarray, "j"], Float[np.ndarray, "k"]]


@dataclass(frozen=True)
class Covariance:
    """Terms of the sum.

    Attributes:
        sds: SD of each term (mm).
        lengths: length of each term (mm).
    """

    sds: tuple[float, ...]
    lengths: tuple[float, ...]

    @property
    def variance(self) -> float:
        """``k(x, x)`` (mm^2)."""
        return sum(sd * sd for sd in self.sds)

    def between(self, a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "n m"]:
        """Covariances of the process between two sets of points (mm^2), in single precision."""
        centre = b.mean(axis=0)
        first, second = (a - centre).astype(np.float32), (b - centre).astype(np.float32)
        lengths = np.square(first).sum(axis=1)[:, None] + np.square(second).sum(axis=1)
        squared = np.maximum(lengths - 2.0 * first @ second.T, 0.0)
        result = np.zeros_like(squared)
        for sd, length in zip(self.sds, self.lengths, strict=True):
            result += np.float32(sd * sd) * np.exp(squared * np.float32(-0.5 / length**2))
        return result

    def summed_on(
        self, axes: Axes, points: Float[np.ndarray, "m 3"], weights: Float[np.ndarray, "m"]
    ) -> Float[np.ndarray, "i j k"]:
        """``sum_m weights_m k(x, points_m)`` at the nodes of a lattice, given by its coordinates along each axis."""
        total = np.zeros(tuple(len(axis) for axis in axes), np.float32)
        for sd, length in zip(self.sds, self.lengths, strict=True):
            x, y, z = (_falls(axis, points[:, number], length) for number, axis in enumerate(axes))
            z *= (sd * sd * weights).astype(np.float32)
            for row, along in enumerate(x):
                total[row] += (y * along) @ z.T
        return total


def _falls(axis: Float[np.ndarray, "i"], coordinate: Float[np.ndarray, "m"], length: float) -> Float[np.ndarray, "i m"]:
    return np.exp(-0.5 * np.square((axis[:, None] - coordinate) / length)).astype(np.float32)
