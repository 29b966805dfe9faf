from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from torch import Tensor

from model.networks.flow import FlowShape
from model.networks.prior import LatentPrior, PriorShape
from tests.random_networks import jacobian, random_prior

PLANE = PriorShape(FlowShape(latent_size=2, transforms=2, bins=4, width=8))
FIVE = PriorShape(FlowShape(latent_size=5, transforms=2, bins=4, width=8))
VARIANTS = [{}, {"standardise": False}, {"use_flow": False}]


def codes(size: int, count: int = 20) -> Tensor:
    return torch.randn(count, size, generator=torch.Generator().manual_seed(7), dtype=torch.float64)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("seed", [0, 1])
def test_density_integrates_to_one(variant, seed):
    prior = random_prior(replace(PLANE, **variant), seed).double()
    line = torch.linspace(-8.5, 8.5, 500, dtype=torch.float64)
    with torch.no_grad():
        density = prior.log_density(torch.cartesian_prod(line, line)).exp()
    assert float(density.sum()) * float(line[1] - line[0]) ** 2 == pytest.approx(1.0, abs=3e-3)


@pytest.mark.parametrize("variant", VARIANTS)
def test_base_coordinates_lead_back_to_the_code(variant):
    prior, z = random_prior(replace(FIVE, **variant)).double(), codes(5)
    with torch.no_grad():
        torch.testing.assert_close(prior.from_base(prior.to_base(z)[0]), z)


@pytest.mark.parametrize("variant", VARIANTS)
def test_density_is_the_change_of_variables(variant):
    prior, z = random_prior(replace(FIVE, **variant)).double(), codes(5)
    base = torch.distributions.Normal(torch.zeros(5).double(), prior.sigma)
    volume = torch.linalg.slogdet(jacobian(lambda v: prior.to_base(v)[0], z)).logabsdet
    expected = base.log_prob(prior.to_base(z)[0]).sum(dim=-1) + volume
    torch.testing.assert_close(prior.log_density(z), expected)


def test_without_flow_the_prior_is_a_gaussian():
    prior, z = random_prior(replace(FIVE, use_flow=False)).double(), codes(5)
    gaussian = torch.distributions.Normal(torch.zeros(5).double(), prior.sigma)
    torch.testing.assert_close(prior.log_density(z), gaussian.log_prob(z).sum(dim=-1))
    assert (prior.log_density(z) - random_prior(FIVE).double().log_density(z)).abs().max() > 0.1


@pytest.mark.parametrize("standardise", [True, False])
def test_a_fresh_prior_is_a_gaussian(standardise):
    prior, z = LatentPrior(replace(FIVE, standardise=standardise, initial_sigma=0.7)).double(), codes(5)
    gaussian = torch.distributions.Normal(0.0, 0.7)
    torch.testing.assert_close(prior.log_density(z), gaussian.log_prob(z).sum(dim=-1), rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("log_sigma", [[0.5] * 5, [-2.0, -1.0, 0.0, 1.0, 2.0], [1.3, -0.2, 0.7, -4.0, 0.1]])
def test_standardised_the_density_scales_with_sigma(log_sigma):
    prior, z = random_prior(FIVE).double(), codes(5)
    unit = random_prior(FIVE).double()
    with torch.no_grad():
        prior.log_sigma.copy_(torch.tensor(log_sigma, dtype=torch.float64))
        unit.log_sigma.zero_()
    expected = unit.log_density(z) - prior.log_sigma.sum()
    torch.testing.assert_close(prior.log_density(z * prior.sigma), expected)


def test_as_in_the_paper_the_flow_does_not_see_sigma():
    prior, z = random_prior(replace(FIVE, standardise=False)).double(), codes(5)
    before = prior.to_base(z)
    with torch.no_grad():
        prior.log_sigma.add_(1.0)
    torch.testing.assert_close(prior.to_base(z), before)


@given(
    st.lists(st.floats(-3.0, 2.0), min_size=4, max_size=4),
    st.floats(1.01, 5.0),
    st.floats(1e-5, 0.99),
)
def test_ard_loss_is_the_negative_log_density_of_gamma_up_to_a_constant(log_sigma, a, b):
    shape = PriorShape(FlowShape(latent_size=4), initial_sigma=1.0)
    prior, reference = LatentPrior(shape).double(), LatentPrior(shape).double()
    with torch.no_grad():
        prior.log_sigma.copy_(torch.tensor(log_sigma, dtype=torch.float64))
    alpha = np.exp(-2.0 * np.array(log_sigma))
    gamma = stats.gamma(a, scale=1.0 / b)
    expected = -gamma.logpdf(alpha).sum() + 4 * gamma.logpdf(1.0)
    found = (prior.ard_loss(a, b) - reference.ard_loss(a, b)).item()
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("use_ard", [True, False])
def test_sigma_learns_only_with_ard(use_ard):
    prior = random_prior(replace(FIVE, use_ard=use_ard)).double()
    (-prior.log_density(codes(5)).mean()).backward()
    assert (prior.log_sigma.grad is not None) == use_ard
    assert all(parameter.grad is not None for parameter in prior.flow.parameters())


def test_without_flow_only_sigma_learns():
    prior = random_prior(replace(FIVE, use_flow=False)).double()
    (-prior.log_density(codes(5)).mean()).backward()
    assert prior.log_sigma.grad is not None
    assert all(parameter.grad is None for parameter in prior.flow.parameters())


def test_gaussian_sigma_of_greatest_density_is_the_spread_of_the_codes():
    prior, z = LatentPrior(replace(FIVE, use_flow=False)).double(), codes(5)
    with torch.no_grad():
        prior.log_sigma.copy_(z.square().mean(dim=0).sqrt().log())
    (-prior.log_density(z).mean()).backward()
    assert prior.log_sigma.grad is not None
    assert prior.log_sigma.grad.abs().max() < 1e-9
