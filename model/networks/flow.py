"""Masked autoregressive spline flow (Papamakarios et al. 2017; Durkan et al. 2019), without learned rotations.

Each transform's splines for dimension i are read off a masked MLP (MADE, Germain et al. 2015) over the dimensions
before i; the order alternates between transforms. The Jacobian is triangular in the transform's own order.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from model.networks import splines
from model.networks.decoder import silu_slope


@dataclass(frozen=True)
class FlowShape:
    """Sizes of a flow.

    Attributes:
        latent_size: D.
        transforms: number of autoregressive transforms.
        bins: K of each spline.
        width: hidden units of each of the two hidden layers of a conditioner.
        bound: the splines act on [-bound, bound].
    """

    latent_size: int = 64
    transforms: int = 2
    bins: int = 4
    width: int = 32
    bound: float = 4.0


class MaskedLinear(nn.Linear):
    """Linear layer whose weights are multiplied by a fixed binary mask."""

    mask: Tensor

    def __init__(self, mask: Float[Tensor, "out in"]) -> None:
        super().__init__(mask.shape[1], mask.shape[0])
        self.register_buffer("mask", mask)

    def masked(self) -> Float[Tensor, "out in"]:
        """``mask * W``."""
        return self.mask * self.weight

    def forward(self, value: Float[Tensor, "*b in"]) -> Float[Tensor, "*b out"]:
        """``(mask * W) x + b``."""
        return functional.linear(value, self.masked(), self.bias)


class SplineTransform(nn.Module):
    """One autoregressive transform ``y_i = spline(x_i; c(x before i))``."""

    def __init__(self, shape: FlowShape, *, reverse: bool) -> None:
        super().__init__()
        self.shape = shape
        order = torch.arange(shape.latent_size)
        order = order.flip(0) if reverse else order
        hidden = torch.arange(shape.width) * max(1, shape.latent_size - 1) // shape.width
        outputs = order.repeat_interleave(splines.parameter_count(shape.bins))
        self.first = MaskedLinear((hidden[:, None] >= order[None, :]).float())
        self.second = MaskedLinear((hidden[:, None] >= hidden[None, :]).float())
        self.last = MaskedLinear((outputs[:, None] > hidden[None, :]).float())
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def knots(self, x: Float[Tensor, "b d"]) -> splines.Knots:
        """Knots of every dimension's spline, each from the dimensions before it."""
        return self._constrained(self._layers(x)[-1])

    def _layers(self, x: Float[Tensor, "b d"]) -> tuple[Tensor, Tensor, Tensor]:
        """Both hidden layers before their activations, and the splines' raw parameters (b, d, p)."""
        first = self.first(x)
        second = self.second(functional.silu(first))
        raw = self.last(functional.silu(second))
        return first, second, raw.unflatten(-1, (self.shape.latent_size, splines.parameter_count(self.shape.bins)))

    def _constrained(self, raw: Float[Tensor, "b d p"]) -> splines.Knots:
        return splines.knots_of(raw, self.shape.bins, self.shape.bound)

    def forward(self, x: Float[Tensor, "b d"]) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b"]]:
        """``y`` and ``log |det dy/dx|``."""
        y, log_slope = splines.forward(x, self.knots(x), self.shape.bound)
        return y, log_slope.sum(dim=-1)

    def jacobian(self, x: Float[Tensor, "b d"]) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b d d"]]:
        """``y`` and ``dy/dx``: a spline depends on its own coordinate and its own parameters, these on the conditioner.

        One backward pass through the splines serves all rows, the conditioner's derivative is a product of matrices.
        """
        first, second, raw = self._layers(x)

        def total(value: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
            y, _ = splines.forward(value, self._constrained(parameters), self.shape.bound)
            return y.sum(), y

        (own, by_raw), y = torch.func.grad(total, argnums=(0, 1), has_aux=True)(x, raw)
        rows = (by_raw[:, :, None] @ self.last.masked().unflatten(0, raw.shape[1:])).squeeze(2)
        rows = (rows * silu_slope(second)[:, None]) @ self.second.masked()
        rows = (rows * silu_slope(first)[:, None]) @ self.first.masked()
        return y, rows + torch.diag_embed(own)

    def inverse_step(self, y: Float[Tensor, "b d"], guess: Float[Tensor, "b d"]) -> Float[Tensor, "b d"]:
        """One fixed-point step towards ``x``; after k steps the first k dimensions (in order) are exact."""
        return splines.inverse(y, self.knots(guess), self.shape.bound)

    def inverse(self, y: Float[Tensor, "b d"]) -> Float[Tensor, "b d"]:
        """``x`` with ``forward(x) = y``: fixed point of `inverse_step`, exact after at most D steps."""
        x = y
        for _ in range(self.shape.latent_size):
            following = self.inverse_step(y, x)
            if torch.equal(following, x):
                break
            x = following
        return x


class SplineFlow(nn.Module):
    """Composition of autoregressive transforms in alternating order."""

    def __init__(self, shape: FlowShape) -> None:
        super().__init__()
        self.shape = shape
        transforms = [SplineTransform(shape, reverse=i % 2 == 1) for i in range(shape.transforms)]
        self.transforms = cast("Sequence[SplineTransform]", nn.ModuleList(transforms))

    def forward(self, x: Float[Tensor, "b d"]) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b"]]:
        """``g(x)`` and ``log |det dg/dx|``."""
        total = torch.zeros_like(x[..., 0])
        for transform in self.transforms:
            x, log_det = transform(x)
            total = total + log_det
        return x, total

    def jacobian(self, x: Float[Tensor, "b d"]) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b d d"]]:
        """``g(x)`` and ``dg/dx``."""
        product = torch.diag_embed(torch.ones_like(x))
        for transform in self.transforms:
            x, factor = transform.jacobian(x)
            product = factor @ product
        return x, product

    def inverse(self, y: Float[Tensor, "b d"]) -> Float[Tensor, "b d"]:
        """``g^-1(y)``."""
        for transform in reversed(self.transforms):
            y = transform.inverse(y)
        return y
