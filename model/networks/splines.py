"""Monotone rational-quadratic splines (Durkan et al. 2019, Neural Spline Flows, section 3.1).

A spline maps [-bound, bound] onto itself through K bins with positive slopes at the knots and is the identity
outside, so that it is a bijection of the real line with continuous first derivative.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

#: Smallest share of the interval that a bin may take, and smallest slope at a knot.
MIN_BIN = 1e-3
MIN_SLOPE = 1e-3
#: softplus(UNIT_SOFTPLUS) is 1.
UNIT_SOFTPLUS = 0.5413248546129181


@dataclass(frozen=True)
class Knots:
    """Knots of a batch of splines.

    Attributes:
        x, y: (..., K + 1) positions, increasing, from -bound to bound.
        slope: (..., K + 1) derivatives, 1 at both ends.
    """

    x: Tensor
    y: Tensor
    slope: Tensor


def parameter_count(bins: int) -> int:
    """Unconstrained numbers that describe one spline: widths, heights and inner slopes."""
    return 3 * bins - 1


def knots_of(parameters: Float[Tensor, "*s p"], bins: int, bound: float) -> Knots:
    """Constrain raw parameters; zeros give the identity."""
    widths, heights, slopes = parameters.split([bins, bins, bins - 1], dim=-1)
    inner = MIN_SLOPE + (1 - MIN_SLOPE) * functional.softplus(slopes + UNIT_SOFTPLUS)
    return Knots(_positions(widths, bound), _positions(heights, bound), functional.pad(inner, (1, 1), value=1.0))


def _positions(raw: Float[Tensor, "*s k"], bound: float) -> Float[Tensor, "*s k1"]:
    bins = raw.shape[-1]
    share = MIN_BIN + (1 - MIN_BIN * bins) * torch.softmax(raw, dim=-1)
    inner = torch.cumsum(share, dim=-1)[..., :-1]
    return functional.pad(functional.pad(2 * bound * inner - bound, (1, 0), value=-bound), (0, 1), value=bound)


def _bin_of(value: Float[Tensor, "*s"], edges: Float[Tensor, "*s k1"]) -> Tensor:
    return (value[..., None] >= edges[..., 1:-1]).sum(dim=-1, keepdim=True)


def _take(table: Float[Tensor, "*s k1"], index: Tensor) -> Float[Tensor, "*s"]:
    return torch.gather(table, -1, index).squeeze(-1)


def _bin_ends(knots: Knots, index: Tensor) -> tuple[Tensor, ...]:
    """Positions, values and slopes at both ends of the chosen bins, and the chord's slope."""
    x0, x1 = _take(knots.x, index), _take(knots.x, index + 1)
    y0, y1 = _take(knots.y, index), _take(knots.y, index + 1)
    d0, d1 = _take(knots.slope, index), _take(knots.slope, index + 1)
    return x0, x1, y0, y1, d0, d1, (y1 - y0) / (x1 - x0)


def forward(x: Float[Tensor, "*s"], knots: Knots, bound: float) -> tuple[Float[Tensor, "*s"], Float[Tensor, "*s"]]:
    """Spline value and log slope (equations 4 and 5)."""
    inside = (x > -bound) & (x < bound)
    safe = torch.where(inside, x, torch.zeros_like(x))
    index = _bin_of(safe, knots.x)
    x0, x1, y0, y1, d0, d1, chord = _bin_ends(knots, index)
    t = (safe - x0) / (x1 - x0)
    y, log_slope = _evaluate(t, y0, y1 - y0, chord, d0, d1)
    return torch.where(inside, y, x), torch.where(inside, log_slope, torch.zeros_like(x))


def _evaluate(t: Tensor, y0: Tensor, height: Tensor, chord: Tensor, d0: Tensor, d1: Tensor) -> tuple[Tensor, Tensor]:
    mix = t * (1 - t)
    denominator = chord + (d0 + d1 - 2 * chord) * mix
    y = y0 + height * (chord * t * t + d0 * mix) / denominator
    rise = d1 * t * t + 2 * chord * mix + d0 * (1 - t) * (1 - t)
    return y, 2 * torch.log(chord) + torch.log(rise) - 2 * torch.log(denominator)


def inverse(y: Float[Tensor, "*s"], knots: Knots, bound: float) -> Float[Tensor, "*s"]:
    """Inverse of `forward` (equations 6 to 8)."""
    inside = (y > -bound) & (y < bound)
    safe = torch.where(inside, y, torch.zeros_like(y))
    index = _bin_of(safe, knots.y)
    x0, x1, y0, y1, d0, d1, chord = _bin_ends(knots, index)
    bend = (safe - y0) * (d0 + d1 - 2 * chord)
    a = (y1 - y0) * (chord - d0) + bend
    b = (y1 - y0) * d0 - bend
    c = -chord * (safe - y0)
    t = 2 * c / (-b - torch.sqrt(torch.clamp(b * b - 4 * a * c, min=0.0)))
    return torch.where(inside, x0 + t * (x1 - x0), y)
