"""Latent prior: spline flow onto a Gaussian whose variances automatic relevance determination (ARD) selects.

    log p(z) = log N(z0; 0, diag(sigma^2)) + log |det dg/dz|,   z0 = g(z)

With `standardise` the flow acts on ``z / sigma`` and its result is scaled back, ``g(z) = sigma h(z / sigma)``: the
splines then see every dimension at its own scale, and scaling cancels in the determinant. Without it the flow acts on
``z`` as the MorphoFlow paper writes it.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from model.networks.flow import FlowShape, SplineFlow


@dataclass(frozen=True)
class PriorShape:
    """Sizes and variants of a prior.

    Attributes:
        flow: sizes of the flow; with ``use_flow`` False ``g`` is the identity.
        use_ard: sigmas are learned; fixed at `initial_sigma` otherwise.
    """

    flow: FlowShape
    use_flow: bool = True
    use_ard: bool = True
    standardise: bool = True
    initial_sigma: float = 0.5


class LatentPrior(nn.Module):
    """``p(z)``, its base coordinates and samples."""

    def __init__(self, shape: PriorShape) -> None:
        super().__init__()
        self.shape = shape
        self.flow = SplineFlow(shape.flow)
        start = torch.full((shape.flow.latent_size,), math.log(shape.initial_sigma))
        self.log_sigma = nn.Parameter(start, requires_grad=shape.use_ard)

    @property
    def sigma(self) -> Float[Tensor, "d"]:
        """Standard deviations of the base, ``alpha^-1/2``."""
        return self.log_sigma.exp()

    def flow_scale(self) -> Float[Tensor, "d"]:
        """Unit of the flow along each dimension."""
        return self.sigma if self.shape.standardise else torch.ones_like(self.log_sigma)

    def to_base(self, latent: Float[Tensor, "b d"]) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b"]]:
        """``z0 = g(z)`` and ``log |det dg/dz|``."""
        if not self.shape.use_flow:
            return latent, torch.zeros_like(latent[..., 0])
        scale = self.flow_scale()
        base, log_det = self.flow(latent / scale)
        return base * scale, log_det

    def base_jacobian(self, latent: Float[Tensor, "b d"]) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b d d"]]:
        """``z0`` and ``dz0/dz``."""
        if not self.shape.use_flow:
            return latent.clone(), torch.diag_embed(torch.ones_like(latent))
        scale = self.flow_scale()
        base, jacobian = self.flow.jacobian(latent / scale)
        return base * scale, scale[:, None] * jacobian / scale

    def from_base(self, base: Float[Tensor, "b d"]) -> Float[Tensor, "b d"]:
        """``z = g^-1(z0)``."""
        if not self.shape.use_flow:
            return base
        scale = self.flow_scale()
        return self.flow.inverse(base / scale) * scale

    def log_density(self, latent: Float[Tensor, "b d"]) -> Float[Tensor, "b"]:
        """``log p(z)`` in nats (change of variables)."""
        base, log_det = self.to_base(latent)
        return self.base_log_density(base) + log_det

    def base_log_density(self, base: Float[Tensor, "b d"]) -> Float[Tensor, "b"]:
        """``log N(z0; 0, diag(sigma^2))`` in nats."""
        gaussian = -0.5 * (base / self.sigma).square() - self.log_sigma - 0.5 * math.log(2 * math.pi)
        return gaussian.sum(dim=-1)

    def ard_loss(self, a: float, b: float) -> Float[Tensor, ""]:
        """``sum_i -(a - 1) log alpha_i + b alpha_i`` with ``alpha_i = exp(-2 log sigma_i)``."""
        log_alpha = -2.0 * self.log_sigma
        return (-(a - 1.0) * log_alpha + b * log_alpha.exp()).sum()
