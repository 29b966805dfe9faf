"""Principal coordinates: another description of the same fields, in which sigmas and distances are in mm."""

import pytest
import torch

from model.networks.decoder import DecoderShape, OccupancyDecoder
from training.principal import length_metric, movements, principal_axes, turned_decoder

SIZE, SHAPES = 5, 40
HALF_MM = (20.0, 18.0, 16.0)


def decoder_of(seed):
    """Balls around the origin that every dimension of the code dents in its own way."""
    torch.manual_seed(seed)
    decoder = OccupancyDecoder(DecoderShape(latent_size=SIZE, width=24, depth=3, extent_mm=20.0)).double()
    optimiser = torch.optim.Adam(decoder.parameters(), 1e-2)
    for _ in range(300):
        points, codes = 40.0 * torch.rand(4, 256, 3).double() - 20.0, torch.randn(4, SIZE).double()
        radius = 10.0 + codes @ torch.linspace(1.0, 0.1, SIZE).double()
        loss = (decoder(codes, points) - (radius[:, None] - points.norm(dim=-1))).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return decoder.float().eval()


@pytest.fixture(scope="module", params=range(2))
def parts(request):
    """A decoder, codes, the covariance of their Gaussians, and axes."""
    decoder = decoder_of(request.param)
    codes = torch.randn(SHAPES, SIZE) @ torch.randn(SIZE, SIZE) * 0.4 + 0.2
    deviation = 0.1 + 0.1 * torch.rand(SHAPES, SIZE)
    covariance = torch.cov(codes.T, correction=0) + torch.diag(deviation.square().mean(dim=0))
    return decoder, codes, covariance, principal_axes(decoder, codes, covariance, HALF_MM, codes.mean(dim=0))


@torch.no_grad()
def test_the_field_stays(parts):
    decoder, codes, _, axes = parts
    points = 20.0 * torch.randn(SHAPES, 50, 3)
    torch.testing.assert_close(
        turned_decoder(decoder, axes)(axes.of(codes), points), decoder(codes, points), atol=2e-3, rtol=1e-3
    )


@torch.no_grad()
def test_coordinates_are_uncorrelated_and_sigmas_theirs(parts):
    _, codes, covariance, axes = parts
    new = axes.of(codes)
    turned = axes.axes.T @ covariance @ axes.axes
    torch.testing.assert_close(turned, torch.diag(axes.sigma.square()), atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(new.mean(dim=0), torch.zeros(SIZE), atol=1e-4, rtol=0.0)
    assert (axes.sigma.diff() <= 0).all()


@torch.no_grad()
def test_a_step_is_as_long_as_the_surface_moves_on_average(parts):
    decoder, codes, _, axes = parts
    moved = movements(turned_decoder(decoder, axes), axes.of(codes), HALF_MM)
    steps = (torch.randn(500, SIZE) * axes.sigma).double()
    means = torch.stack([(found @ steps.T).abs().mean(dim=0) for found in moved]).square().mean(dim=0).sqrt()
    ratio = means / steps.norm(dim=1)
    assert float(ratio.mean()) == pytest.approx(1.0, abs=0.02)
    assert float(ratio.std()) < 0.1


@torch.no_grad()
def test_a_known_metric_is_found():
    """Points that all move alike make the mean movement the absolute value of a product, and M its square."""
    direction = torch.tensor([[0.5, -2.0, 1.0]]).double()
    torch.testing.assert_close(length_metric([direction.expand(7, 3)]), direction.T @ direction, atol=1e-6, rtol=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("size", [8, 40])
def test_directions_that_move_little_are_measured_too(size):
    """Movements over three orders of magnitude: each axis of the metric is as long as the surface moves along it."""
    generator = torch.Generator().manual_seed(size)
    scales = torch.logspace(0, -3, size, dtype=torch.float64)
    mixing = torch.linalg.qr(torch.randn(size, size, generator=generator, dtype=torch.float64)).Q
    drawn = [torch.randn(300, size, generator=generator, dtype=torch.float64) for _ in range(8)]
    moved = [one.abs().sqrt() * one * scales for one in drawn]
    squares, axes = torch.linalg.eigh(length_metric([found @ mixing for found in moved]))
    means = torch.stack([(found @ mixing @ axes).abs().mean(dim=0) for found in moved]).square().mean(dim=0).sqrt()
    assert (squares > 0).all()
    ratio = squares.sqrt() / means
    assert 0.7 < float(ratio.min()) <= float(ratio.max()) < 1.6


@torch.no_grad()
def test_movements_are_those_of_the_surface(parts):
    """A small step of the code against the distance at which the surface is found again along its normals."""
    decoder, codes, _, _ = parts
    code, step = codes[:1], 1e-3 * torch.randn(1, SIZE)
    points = on_surface(decoder, code, 10.0 * torch.nn.functional.normalize(torch.randn(1, 4000, 3), dim=-1))
    _, by_latent, by_point = decoder.jacobians(code, points)
    slope = by_point.norm(dim=-1)
    first_order = (by_latent @ step[0]) / slope
    moved = on_surface(decoder, code + step, points)
    along = ((moved - points) * -by_point).sum(dim=-1) / slope
    torch.testing.assert_close(along, first_order, atol=2e-4, rtol=0.05)


def on_surface(decoder, code, points):
    """Points carried to the iso-level along the gradient."""
    for _ in range(8):
        logits, _, by_point = decoder.jacobians(code, points)
        points = points - (logits / by_point.square().sum(dim=-1))[..., None] * by_point
    return points


def test_the_same_codes_give_the_same_axes(parts):
    decoder, codes, covariance, axes = parts
    again = principal_axes(decoder, codes, covariance, HALF_MM, codes.mean(dim=0))
    torch.testing.assert_close(again.axes, axes.axes, atol=1e-4, rtol=1e-3)
