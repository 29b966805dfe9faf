"""Latent coordinates along the principal movements of the surface.

A latent code is known up to an affine change of coordinates, which decoder and prior absorb. It is chosen here so that
coordinates are uncorrelated over the population and a step of the code is as long as the surface moves: the mean
distance along the normal over the surface (mm), to first order, on average over training codes. Sigmas are then
movements in mm, largest first, and distances between codes are average surface distances, as far as the decoder bends
little between them. It is to the decoder what principal component analysis is to a set of points.
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
#: Of a decoder so little trained that it has none there the nearest few do.
SHELL_MM, FEWEST = 1.0, 64
#: Steps by which lengths are fitted: at least so many, and so many for each number that is sought.
STEPS, STEPS_EACH = 4000, 4
#: Weight of the departure from the metric of root mean squares: residuals of the fit are about 0.1, departures 0.2.
DEPARTURE_WEIGHT = 0.25
#: Movements below this share of the largest are taken for it, so that no coordinate is without length.
LEAST_MOVEMENT = 1e-3


@dataclass(frozen=True)
class PrincipalAxes:
    """The change of coordinates ``z' = (z - centre) axes``.

    Attributes:
        axes: (k, k), of full rank.
        sigma: (k,) standard deviation of each new coordinate over the population (mm), largest first.
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
    covariance: Float[Tensor, "k k"],
    half_extent_mm: Sequence[float],
    centre: Float[Tensor, "k"],
) -> PrincipalAxes:
    """Axes of a population of codes.

    Args:
        codes: training codes, at whose surfaces movements are measured.
        covariance: of the population.
        half_extent_mm: half sides of the box that holds the surfaces.
        centre: of the population.
    """
    spread = torch.linalg.cholesky(covariance.double())
    squares, turn = torch.linalg.eigh(
        length_metric([found @ spread for found in movements(decoder, codes, half_extent_mm)])
    )
    sigma = squares.clamp(min=float(squares.max()) * LEAST_MOVEMENT**2).sqrt().flip(0)
    axes = torch.linalg.solve_triangular(spread.T, turn.flip(1), upper=True) * sigma
    largest = axes.abs().argmax(dim=0)
    axes = axes * axes.gather(0, largest[None]).sign()
    return PrincipalAxes(centre, axes.float(), sigma.float())


@torch.no_grad()
def movements(
    decoder: OccupancyDecoder, codes: Float[Tensor, "m k"], half_extent_mm: Sequence[float]
) -> list[Float[Tensor, "_ k"]]:
    """For some of the codes the movement (mm) of their surface's points along the normal by each coordinate."""
    generator = torch.Generator().manual_seed(0)
    found = []
    for code in codes[torch.linspace(0, len(codes) - 1, min(CODES, len(codes))).round().long()]:
        points = (2.0 * torch.rand(POINTS, 3, generator=generator) - 1.0) * torch.tensor(half_extent_mm)
        logits, by_latent, by_point = decoder.jacobians(code[None], points[None])
        slope = by_point[0].norm(dim=1).clamp(min=1e-6)
        gap = logits[0].abs() / slope
        near = gap <= max(SHELL_MM, float(gap.kthvalue(FEWEST).values))
        found.append((by_latent[0][near] / slope[near, None]).double())
    return found


@torch.no_grad()
def length_metric(moved: Sequence[Float[Tensor, "_ k"]]) -> Float[Tensor, "k k"]:
    """Least squares fit, in relative terms, of ``w^T M w`` to the squared mean movement by standard normal steps w.

    Such steps say next to nothing of directions that move the surface little beside others. So what is fitted is the
    departure of ``M`` from the metric of root mean square movements, to scale, in coordinates in which that is the
    identity: it stays small where the steps do not tell.
    """
    size = moved[0].shape[1]
    count = max(STEPS, STEPS_EACH * size * (size + 1) // 2)
    steps = torch.randn(count, size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    squares = torch.stack([(found @ steps.T).abs().mean(dim=0).square() for found in moved]).mean(dim=0)
    lengths = squares.clamp(min=float(squares.max()) * 1e-12).sqrt()
    values, vectors = torch.linalg.eigh(torch.stack([found.T @ found / len(found) for found in moved]).mean(dim=0))
    roots = values.clamp(min=0.0).sqrt()[:, None] * vectors.T
    whitened = steps @ roots.T / lengths[:, None]
    ratio = whitened.square().sum(dim=1)
    scale = ratio.sum() / ratio.square().sum()
    departure = _fitted_form(scale.sqrt() * whitened, 1.0 - scale * ratio)
    return torch.as_tensor(scale * roots.T @ (torch.eye(size, dtype=torch.float64) + departure) @ roots)


def _fitted_form(points: Float[Tensor, "n k"], values: Float[Tensor, "n"]) -> Float[Tensor, "k k"]:
    """Symmetric ``D`` for which ``x^T D x`` comes near to values at points, kept small by `DEPARTURE_WEIGHT`."""
    size = points.shape[1]
    rows, columns = torch.triu_indices(size, size)
    products = points[:, rows] * points[:, columns] * torch.where(rows == columns, 1.0, 2.0)
    normal = products.T @ products + DEPARTURE_WEIGHT * torch.eye(len(rows), dtype=torch.float64)
    form = torch.zeros(size, size, dtype=torch.float64)
    form[rows, columns] = torch.linalg.solve(normal, products.T @ values)
    return form + form.T - torch.diag(form.diag())


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
