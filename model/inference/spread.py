"""Posterior of the surface's movement along its normal, to first order."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from model.inference.discrepancy.gathering import GatheredPoints
from model.inference.discrepancy.process import FEW, Discrepancy


@dataclass(frozen=True)
class LocalSpread:
    """What the discrepancy leaves open at the vertices.

    Attributes:
        discrepancy: the process.
        canonical: (v, 3) vertices (canonical mm).
        variance: (v,) of the process there (mm^2).
        reach: (v,) outward movement (mm) of a vertex for one mm of the process.
    """

    discrepancy: Discrepancy
    canonical: Float[np.ndarray, "v 3"]
    variance: Float[np.ndarray, "v"]
    reach: Float[np.ndarray, "v"]

    def variance_of(self, slope: Float[np.ndarray, "v"]) -> float:
        """Variance of a figure that changes by ``slope_v`` for a mm of outward movement of vertex v."""
        moved = np.flatnonzero(slope)
        if len(moved) <= FEW:
            return self.discrepancy.functional_variance(self.canonical[moved], slope[moved] * self.reach[moved])
        return self.discrepancy.functional_variance(self.canonical, slope * self.reach, self._gathered)

    @cached_property
    def _gathered(self) -> GatheredPoints:
        return self.discrepancy.gathered(self.canonical)


@dataclass(frozen=True)
class SurfaceSpread:
    """Covariance of the vertices' outward movements (mm^2): ``F F^T`` and that of the discrepancy.

    Attributes:
        factors: (v, k) ``F``, by the Laplace posterior over code and pose, or over an ensemble.
        local: the discrepancy's share, None without one.
    """

    factors: Float[np.ndarray, "v k"]
    local: LocalSpread | None = None

    def sd(self) -> Float[np.ndarray, "v"]:
        """SD of each vertex (mm)."""
        variance = np.square(self.factors).sum(axis=1)
        if self.local is not None:
            variance = variance + np.square(self.local.reach) * self.local.variance
        return np.asarray(np.sqrt(variance))

    def sd_of(self, slope: Float[np.ndarray, "v"]) -> float:
        """SD of a figure that changes by ``slope_v`` for a mm of outward movement of vertex v."""
        variance = float(np.square(slope.astype(self.factors.dtype) @ self.factors).sum())
        return float(np.sqrt(variance if self.local is None else variance + self.local.variance_of(slope)))
