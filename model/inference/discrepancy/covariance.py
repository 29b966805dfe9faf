"""Covariance of a stationary, isotropic Gaussian process: a sum of squared exponentials.

    k(x, x') = sum_j sd_j^2 exp(-|x - x'|^2 / (2 length_j^2))

Several lengths make one process that is both locally rough and correlated far (Rasmussen and Williams 2006, section
4.2). Each term is a product over the axes, so that its sums over points on a whole lattice are matrix products.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

#: Covariances computed at a time: few enough to stay in a core's cache.
BLOCK = 1 << 16
#: Falls below this are none.
NEGLIGIBLE = 1e-6
#: Falls along one axis below the first are zero, and no exponent is below the second: what is smaller would be told by
#: denormal numbers, with which processors calculate a hundred times as slowly.
LEAST_FALL, LEAST_EXPONENT = 1e-9, np.float32(-30.0)

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
        result = np.empty((len(a), len(b)), np.float32)
        step = max(1, BLOCK // max(len(b), 1))
        for start in range(0, len(a), step):
            piece = first[start : start + step]
            squared = piece @ (-2.0 * second.T)
            squared += np.square(piece).sum(axis=1)[:, None]
            squared += np.square(second).sum(axis=1)
            self._fill(result[start : start + step], np.maximum(squared, 0.0, out=squared))
        return result

    def with_chosen(
        self, a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"], chosen: Int[np.ndarray, "n k"]
    ) -> Float[np.ndarray, "n k"]:
        """Covariances of the process between each point and its own choice of others (mm^2), in single precision."""
        centre = b.mean(axis=0)
        first, second = (a - centre).astype(np.float32), np.ascontiguousarray((b - centre).T, np.float32)
        result = np.empty(chosen.shape, np.float32)
        step = max(1, BLOCK // max(chosen.shape[1], 1))
        for start in range(0, len(a), step):
            numbers, piece = chosen[start : start + step], first[start : start + step]
            squared = np.square(second[0][numbers] - piece[:, :1])
            for axis in (1, 2):
                squared += np.square(second[axis][numbers] - piece[:, axis, None])
            self._fill(result[start : start + step], squared)
        return result

    def _fill(self, result: Float[np.ndarray, "n m"], squared: Float[np.ndarray, "n m"]) -> None:
        """Covariances at squared distances (mm^2)."""
        term = np.empty_like(squared)
        for number, (sd, length) in enumerate(zip(self.sds, self.lengths, strict=True)):
            np.multiply(squared, np.float32(-0.5 / length**2), out=term)
            np.maximum(term, LEAST_EXPONENT, out=term)
            np.exp(term, out=term)
            term *= np.float32(sd * sd)
            np.add(result, term, out=result) if number else np.copyto(result, term)

    def summed_on(
        self, axes: Axes, points: Float[np.ndarray, "m 3"], weights: Float[np.ndarray, "m"]
    ) -> Float[np.ndarray, "i j k"]:
        """``sum_m weights_m k(x, points_m)`` at the nodes of a lattice, given by its coordinates along each axis."""
        total = np.zeros(tuple(len(axis) for axis in axes), np.float32)
        for sd, length in zip(self.sds, self.lengths, strict=True):
            x, y, z = (falls(axis, points[:, number], length) for number, axis in enumerate(axes))
            z *= (sd * sd * weights).astype(np.float32)
            for row, along in enumerate(x):
                near = along > NEGLIGIBLE
                total[row] += (y[:, near] * along[near]) @ z[:, near].T
        return total

    def drawn_on(self, axes: Axes, random: np.random.Generator) -> Float[np.ndarray, "i j k"]:
        """A draw of the process (mm) at the nodes of a lattice: on each axis a root of the term's covariance."""
        total = np.zeros(tuple(len(axis) for axis in axes), np.float32)
        for sd, length in zip(self.sds, self.lengths, strict=True):
            field = random.standard_normal(total.shape).astype(np.float32)
            for axis in reversed(axes):
                field = np.tensordot(_root(falls(axis, axis, length)), field, (1, 2))
            total += np.float32(sd) * field
        return total


def _root(covariance: Float[np.ndarray, "i i"]) -> Float[np.ndarray, "i i"]:
    """``R`` with ``R R^T`` the covariance, which may be singular to rounding."""
    values, vectors = np.linalg.eigh(covariance.astype(float))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)), np.float32)


def falls(axis: Float[np.ndarray, "i"], coordinate: Float[np.ndarray, "m"], length: float) -> Float[np.ndarray, "i m"]:
    """Share of a term's variance that distances (mm) along one axis leave, for its length (mm)."""
    left = np.exp(-0.5 * np.square((axis[:, None] - coordinate) / length))
    return np.where(left < LEAST_FALL, 0.0, left).astype(np.float32)
