"""Latent coordinates along the principal movements of the surface.

A latent code is known up to an affine change of coordinates, which decoder and prior absorb. It is chosen here so that
coordinates are uncorrelated over the training codes and a step of the code is as long as the surface moves: the root
mean square of the movement along the normal over the surface (mm), to first order, on average over training codes.
Sigmas are then movements in mm, largest first, and distances between codes those between their surfaces, as far as the
decoder bends little between them. It is to the decoder what principal component analysis is to a set of points.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from model.networks.decoder import OccupancyDecoder

#: Training codes at whose surfaces movements are measured, and points of the box that are tried for each.
CODES, POINTS = 24, 1 << 14
#: Points so near to the surface (mm, to first order) stand for it: uniform ones in a thin shell are uniform over area.
SHELL_MM = 1.0
#: Movements below this share of the largest are taken for it, so that no coordinate is without length.
LEAST_MOVEMENT = 1e-3


@dataclass(frozen=True)
class PrincipalAxes:
    """The change of coordinates ``z' = (z - centre) axes``.

    Attributes:
        axes: (k, k), of full rank.
        sigma: (k,) standard deviation of each new coordinate over the training codes (mm), largest first.
    """

    centre: Float[Tensor, "k"]
    axes: Float[Tensor, "k k"]
    sigma: Float[Tensor, "k"]

    def of(self, codes: Float[Tensor, "m k"]) -> Float[Tensor, "m k"]:
        """Codes in the new coordinates."""
        return (codes - self.centre) @ self.axes


@torch.no_grad()
def principal_axes(
    decoder: OccupancyDecoder,
    codes: Float[Tensor, "m k"],
    deviation: Float[Tensor, "m k"],
    half_extent_mm: Sequence[float],
) -> PrincipalAxes:
    """Axes of Gaussian codes: their means, standard deviations, and the box (mm) that holds their surfaces."""
    centre = codes.mean(dim=0)
    covariance = torch.cov(codes.T, correction=0) + torch.diag(deviation.square().mean(dim=0))
    values, vectors = torch.linalg.eigh(surface_metric(decoder, codes, half_extent_mm))
    root = vectors * values.clamp(min=float(values.max()) * LEAST_MOVEMENT**2).sqrt()
    variances, turn = torch.linalg.eigh(root.T @ covariance.double() @ root)
    axes = (root @ turn).flip(1)
    largest = axes.abs().argmax(dim=0)
    axes = axes * axes.gather(0, largest[None]).sign()
    return PrincipalAxes(centre, axes.float(), variances.flip(0).clamp(min=1e-12).sqrt().float())


@torch.no_grad()
def surface_metric(
    decoder: OccupancyDecoder, codes: Float[Tensor, "m k"], half_extent_mm: Sequence[float]
) -> Float[Tensor, "k k"]:
    """Mean over surfaces, of some codes, of the outer product of the movement along the normal (mm) by the code."""
    generator = torch.Generator().manual_seed(0)
    chosen = codes[torch.linspace(0, len(codes) - 1, min(CODES, len(codes))).round().long()]
    movements = []
    for code in chosen:
        points = (2.0 * torch.rand(POINTS, 3, generator=generator) - 1.0) * torch.tensor(half_extent_mm)
        logits, by_latent, by_point = decoder.jacobians(code[None], points[None])
        slope = by_point[0].norm(dim=1).clamp(min=1e-6)
        near = logits[0].abs() < SHELL_MM * slope
        movements.append(by_latent[0][near] / slope[near, None])
    every = torch.cat(movements).double()
    return every.T @ every / max(len(every), 1)


@torch.no_grad()
def turned_decoder(decoder: OccupancyDecoder, axes: PrincipalAxes) -> OccupancyDecoder:
    """The decoder over the new coordinates: its field at ``z'`` is the old one's at ``z``."""
    result = OccupancyDecoder(replace(decoder.shape, unit_columns=False))
    back = torch.linalg.inv(axes.axes.double()).T.float()
    weights = decoder.latent_weights()
    result.load_state_dict({**decoder.state_dict(), "from_latent": torch.cat(weights) @ back})
    for layer, weight in zip(result.from_point, weights, strict=True):
        layer.bias.add_(weight @ axes.centre)
    return result
