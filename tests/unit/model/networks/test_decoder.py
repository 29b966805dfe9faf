from dataclasses import replace

import pytest
import torch
from torch import Tensor

from model.errors import InvalidParameter
from model.networks.decoder import DecoderShape, OccupancyDecoder, silu_slope
from tests.random_networks import random_decoder

SHAPE = DecoderShape(latent_size=5, width=12, depth=4, extent_mm=25.0)


def inputs(shapes: int = 3, points: int = 17) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(1)
    latent = torch.randn(shapes, 5, generator=random, dtype=torch.float64)
    return latent, 15.0 * torch.randn(shapes, points, 3, generator=random, dtype=torch.float64)


def decoder_of(**changes: int | float | bool) -> OccupancyDecoder:
    return random_decoder(replace(SHAPE, **changes)).double()


@pytest.mark.parametrize("depth", [2, 3, 4, 7])
@pytest.mark.parametrize("unit_columns", [True, False])
def test_jacobians_are_those_of_automatic_differentiation(depth, unit_columns):
    decoder = decoder_of(depth=depth, unit_columns=unit_columns)
    latent, points = inputs()
    copies = latent[:, None].expand(-1, points.shape[1], -1).reshape(-1, 5).requires_grad_(True)
    single = points.reshape(-1, 1, 3).requires_grad_(True)
    logits = decoder(copies, single)
    by_latent, by_point = torch.autograd.grad(logits.sum(), (copies, single))
    found = decoder.jacobians(latent, points)
    torch.testing.assert_close(found[0], logits.reshape(3, -1))
    torch.testing.assert_close(found[1], by_latent.reshape(3, -1, 5))
    torch.testing.assert_close(found[2], by_point.reshape(3, -1, 3))
    assert found[1].abs().max() > 1e-3
    assert found[2].abs().max() > 1e-3


def test_logits_of_both_ways_are_equal():
    latent, points = inputs()
    decoder = decoder_of()
    torch.testing.assert_close(decoder.jacobians(latent, points)[0], decoder(latent, points))


@pytest.mark.parametrize("depth", [2, 3, 4, 7])
@pytest.mark.parametrize("unit_columns", [True, False])
def test_the_derivative_along_a_step_is_the_jacobian_times_it(depth, unit_columns):
    decoder = decoder_of(depth=depth, unit_columns=unit_columns)
    latent, points = inputs()
    step = torch.randn(5, generator=torch.Generator().manual_seed(9)).double()
    logits, moved = decoder.directional_derivative(latent, points, step)
    expected, by_latent, _ = decoder.jacobians(latent, points)
    torch.testing.assert_close(logits, expected)
    torch.testing.assert_close(moved, by_latent @ step)


def test_latent_weights_have_unit_norm_over_both_entries():
    weights = torch.cat(decoder_of().latent_weights())
    torch.testing.assert_close(weights.norm(dim=0), torch.ones(5).double())
    assert (torch.cat(decoder_of(unit_columns=False).latent_weights()).norm(dim=0) - 1).abs().max() > 1e-2


@pytest.mark.parametrize("unit_columns", [True, False])
def test_length_of_a_latent_column_matters_only_without_unit_norm(unit_columns):
    latent, points = inputs()
    decoder = decoder_of(unit_columns=unit_columns)
    before = decoder(latent, points)
    with torch.no_grad():
        decoder.from_latent[:, 2] *= 3.0
    assert torch.allclose(before, decoder(latent, points), atol=1e-9) == unit_columns


def test_shapes_and_points_do_not_touch_each_other():
    latent, points = inputs()
    decoder = decoder_of()
    together = decoder(latent, points)
    for shape in range(3):
        torch.testing.assert_close(
            decoder(latent[shape : shape + 1], points[shape : shape + 1]), together[shape : shape + 1]
        )
    order = torch.randperm(points.shape[1], generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(decoder(latent, points[:, order]), together[:, order])


def test_the_extent_is_the_unit_of_length():
    latent, points = inputs()
    one, other = decoder_of(), decoder_of(extent_mm=50.0)
    other.load_state_dict(one.state_dict())
    torch.testing.assert_close(one(latent, points), other(latent, 2.0 * points))
    torch.testing.assert_close(one.jacobians(latent, points)[2], 2.0 * other.jacobians(latent, 2.0 * points)[2])


def test_slope_of_silu():
    value = torch.linspace(-20, 20, 101, dtype=torch.float64, requires_grad=True)
    (expected,) = torch.autograd.grad(torch.nn.functional.silu(value).sum(), value)
    torch.testing.assert_close(silu_slope(value.detach()), expected)


def test_too_few_layers_are_refused():
    with pytest.raises(InvalidParameter) as caught:
        DecoderShape(depth=1)
    assert caught.value.part == "depth"
