"""Weighted sums of a stationary process over many points, by gathering the weights on lattices.

Each weight is spread over the 27 nodes around its point by quadratic B-splines (the triangular shaped cloud of particle
methods; Hockney and Eastwood 1988, section 5-3). Their second moment is a quarter of the squared step wherever in its
cell the point lies, so a squared exponential that is as much narrower, and higher, makes up for the spreading to
fourth order in the step, on a sheet of points as in a cloud of them.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array

from model.inference.discrepancy.covariance import NEGLIGIBLE, Axes, Covariance, falls

#: Step of a term's lattice, in its lengths.
LATTICE_SHARE = 0.5
#: Variance that spreading adds on each axis, in squared steps.
SPREAD = 0.25


@dataclass(frozen=True)
class PointLattice:
    """Points spread over the nodes of a lattice.

    Attributes:
        axes: coordinates of the nodes along each axis (mm).
        shares: (m, nodes) share of each point at each node; rows sum to one.
    """

    axes: Axes
    shares: csr_array

    def gathered(self, weights: Float[np.ndarray, "m"]) -> Float[np.ndarray, "i j k"]:
        """Weights of the points at the nodes."""
        found = self.shares.T @ weights.astype(np.float32)
        return np.asarray(found).reshape(tuple(len(axis) for axis in self.axes))


@dataclass(frozen=True)
class GatheredPoints:
    """Points of which weighted sums of a process are asked for, on a lattice for each term of its covariance.

    Attributes:
        covariance: of the process (mm^2).
        lattices: one a term.
    """

    covariance: Covariance
    lattices: tuple[PointLattice, ...]

    @classmethod
    def of(cls, covariance: Covariance, points: Float[np.ndarray, "m 3"]) -> "GatheredPoints":
        """Points (mm) under a covariance."""
        return cls(covariance, tuple(_lattice(points, LATTICE_SHARE * length) for length in covariance.lengths))

    def variance_of(self, weights: Float[np.ndarray, "m"]) -> float:
        """``sum_mn weights_m weights_n k(points_m, points_n)``: the variance of the weighted sum."""
        total = 0.0
        for variance, length, lattice in self._terms(2.0 * SPREAD):
            smooth = gathered = lattice.gathered(weights)
            for axis in reversed(lattice.axes):
                smooth = np.tensordot(falls(axis, axis, length), smooth, (1, 2))
            total += variance * float(np.sum(gathered * smooth, dtype=float))
        return total

    def covariances_with(
        self, places: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, "m"]
    ) -> Float[np.ndarray, "n"]:
        """``sum_m weights_m k(places_n, points_m)``: covariances of the weighted sum with the process at places."""
        total = np.zeros(len(places))
        for variance, length, lattice in self._terms(SPREAD):
            gathered = lattice.gathered(weights)
            x, y, z = (falls(axis, places[:, number], length) for number, axis in enumerate(lattice.axes))
            for row, along in zip(gathered, x, strict=True):
                near = along > NEGLIGIBLE
                total[near] += variance * along[near] * np.einsum("kn,kn->n", row.T @ y[:, near], z[:, near])
        return total

    def _terms(self, spread: float) -> Iterator[tuple[float, float, PointLattice]]:
        """Variance (mm^2) and length (mm) of each term, narrowed for so much spreading (squared steps)."""
        narrowed = 1.0 - spread * LATTICE_SHARE**2
        for sd, length, lattice in zip(self.covariance.sds, self.covariance.lengths, self.lattices, strict=True):
            yield sd * sd * narrowed**-1.5, length * narrowed**0.5, lattice


def _lattice(points: Float[np.ndarray, "m 3"], step: float) -> PointLattice:
    """Points (mm) on a lattice of this step (mm) that holds all nodes next to them."""
    low = points.min(axis=0)
    places = (points - low) / step + 1.0
    nearest = np.rint(places).astype(np.int32)
    shape = nearest.max(axis=0) + 2
    x, y, z = (_shares((places - nearest)[:, axis]) for axis in range(3))
    shares = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).reshape(len(points), -1)
    offsets = np.stack(np.meshgrid(*3 * [np.arange(-1, 2)], indexing="ij"), axis=-1).reshape(-1, 3)
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    nodes = (nearest @ strides)[:, None] + offsets @ strides
    ends = np.arange(0, shares.size + 1, shares.shape[1])
    i, j, k = (start + step * (np.arange(count) - 1.0) for start, count in zip(low, shape, strict=True))
    return PointLattice((i, j, k), csr_array((shares.ravel(), nodes.ravel(), ends), (len(points), int(shape.prod()))))


def _shares(past: Float[np.ndarray, "m"]) -> Float[np.ndarray, "m 3"]:
    """Shares of the node before, at and after a point that lies so far (steps) past its nearest node."""
    shares = (0.5 * np.square(0.5 - past), 0.75 - np.square(past), 0.5 * np.square(0.5 + past))
    return np.stack(shares, axis=1).astype(np.float32)
