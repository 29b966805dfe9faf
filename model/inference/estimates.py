"""Figures of a surface with intervals, to first order in its movement."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from model.inference.spread import SurfaceSpread

#: Share of the posterior that intervals hold.
LEVEL = 0.9


@dataclass(frozen=True)
class Estimate:
    """A figure with its 90 % interval; `low` and `high` are None when uncertainty was not asked for."""

    value: float
    low: float | None
    high: float | None


def interval_reach(level: float) -> float:
    """Half width, in SDs, of the interval around the mean that holds this share of a normal distribution."""
    return float(ndtri(0.5 + 0.5 * level))


def sd_of_estimate(estimate: Estimate, level: float = LEVEL) -> float:
    """SD of a figure from its interval; 0 without one."""
    if estimate.high is None:
        return 0.0
    return (estimate.high - estimate.value) / interval_reach(level)


def estimate_of(
    value: float, slope: Float[np.ndarray, "v"], spread: SurfaceSpread | None, level: float = LEVEL
) -> Estimate:
    """A figure that changes by ``slope_v`` for a mm of outward movement of vertex v, never below 0."""
    if spread is None:
        return Estimate(value, None, None)
    reach = interval_reach(level) * spread.sd_of(slope)
    return Estimate(value, max(0.0, value - reach), value + reach)
