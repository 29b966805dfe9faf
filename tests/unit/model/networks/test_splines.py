import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from model.networks import splines

BOUND = 3.0
BINS = st.integers(1, 7)
SEEDS = st.integers(0, 2**31)
SPREADS = st.sampled_from([0.0, 0.3, 1.0, 3.0])


def knots(bins: int, seed: int, spread: float, count: int = 40) -> splines.Knots:
    random = torch.Generator().manual_seed(seed)
    raw = spread * torch.randn(count, splines.parameter_count(bins), generator=random, dtype=torch.float64)
    return splines.knots_of(raw, bins, BOUND)


def inside(seed: int, count: int = 40) -> Tensor:
    random = torch.Generator().manual_seed(seed + 1)
    return BOUND * (2 * torch.rand(count, generator=random, dtype=torch.float64) - 1)


@given(BINS, SEEDS, SPREADS)
def test_inverse_undoes_forward_and_forward_undoes_inverse(bins, seed, spread):
    spline, x = knots(bins, seed, spread), 1.5 * inside(seed)
    torch.testing.assert_close(splines.inverse(splines.forward(x, spline, BOUND)[0], spline, BOUND), x)
    torch.testing.assert_close(splines.forward(splines.inverse(x, spline, BOUND), spline, BOUND)[0], x)


@given(BINS, SEEDS, SPREADS)
def test_log_slope_is_the_logarithm_of_the_derivative(bins, seed, spread):
    spline, x = knots(bins, seed, spread), (1.5 * inside(seed)).requires_grad_(True)
    y, log_slope = splines.forward(x, spline, BOUND)
    (derivative,) = torch.autograd.grad(y.sum(), x)
    assert (derivative > 0).all()
    torch.testing.assert_close(log_slope, derivative.log())


@given(BINS, SEEDS, SPREADS)
def test_knots_are_met_in_place_and_slope(bins, seed, spread):
    spline = knots(bins, seed, spread)
    assert (spline.x.diff() > 0).all()
    assert (spline.y.diff() > 0).all()
    for number in range(bins + 1):
        y, log_slope = splines.forward(spline.x[:, number].contiguous(), spline, BOUND)
        torch.testing.assert_close(y, spline.y[:, number])
        torch.testing.assert_close(log_slope.exp(), spline.slope[:, number])


@given(BINS, SEEDS, st.floats(1.0, 100.0), st.sampled_from([-1.0, 1.0]))
def test_outside_the_bound_the_spline_is_the_identity(bins, seed, factor, sign):
    spline, x = knots(bins, seed, 2.0), torch.full((40,), sign * factor * BOUND, dtype=torch.float64)
    y, log_slope = splines.forward(x, spline, BOUND)
    assert torch.equal(y, x)
    assert not log_slope.any()
    assert torch.equal(splines.inverse(x, spline, BOUND), x)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_value_and_slope_are_continuous_at_the_bound(sign):
    spline = knots(4, 0, 1.0)
    y, log_slope = splines.forward(torch.full((40,), sign * (BOUND - 1e-9), dtype=torch.float64), spline, BOUND)
    assert (y - sign * BOUND).abs().max() < 1e-6
    assert log_slope.abs().max() < 1e-5


@given(BINS, SEEDS)
def test_zeros_give_the_identity(bins, seed):
    x = 1.5 * inside(seed)
    y, log_slope = splines.forward(x, knots(bins, seed, 0.0), BOUND)
    torch.testing.assert_close(y, x)
    assert log_slope.abs().max() < 1e-9


@given(BINS, SEEDS, SPREADS)
def test_order_is_kept(bins, seed, spread):
    spline = knots(bins, seed, spread, count=1)
    line = torch.linspace(-1.2 * BOUND, 1.2 * BOUND, 300, dtype=torch.float64)
    wide = splines.Knots(*(part.expand(300, -1) for part in (spline.x, spline.y, spline.slope)))
    assert (splines.forward(line, wide, BOUND)[0].diff() > 0).all()


def test_random_splines_bend():
    x = inside(0)
    y, log_slope = splines.forward(x, knots(5, 0, 1.0), BOUND)
    assert (y - x).abs().max() > 0.5
    assert log_slope.abs().max() > 0.5
