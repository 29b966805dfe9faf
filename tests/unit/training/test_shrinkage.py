"""Shrinkage: between the codes' own covariance and the target, nearer to the target where codes are few."""

import pytest
import torch

from training.prior_fit import Codes
from training.shrinkage import SHARES, shrunk_covariance

SIZE = 12


def codes_of(count, covariance, seed, deviation=0.0):
    generator = torch.Generator().manual_seed(seed)
    spread = torch.linalg.cholesky(covariance)
    means = torch.randn(count, SIZE, generator=generator, dtype=torch.float64) @ spread.T
    return Codes(means, torch.full((count, SIZE), deviation, dtype=torch.float64), torch.arange(count))


@pytest.fixture(scope="module")
def truth():
    root = torch.randn(SIZE, SIZE, generator=torch.Generator().manual_seed(3), dtype=torch.float64) / SIZE**0.5
    return root @ root.T + 0.05 * torch.eye(SIZE, dtype=torch.float64)


@pytest.mark.parametrize("seed", range(3))
def test_many_codes_need_no_target(truth, seed):
    found, share = shrunk_covariance(codes_of(20_000, truth, seed), torch.eye(SIZE))
    assert share <= 0.02
    torch.testing.assert_close(found, truth, atol=0.1, rtol=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_few_codes_lean_on_a_target_that_is_right(truth, seed):
    _, share = shrunk_covariance(codes_of(15, truth, seed), truth)
    assert share >= 0.5


@pytest.mark.parametrize("count", [20, 40, 80])
def test_codes_that_were_never_seen_are_more_probable_than_without(truth, count):
    """Mean over draws of the log density of new codes, under the shrunk covariance and under the codes' own."""
    target = truth.diag().mean() * torch.eye(SIZE, dtype=torch.float64)
    gains = []
    for seed in range(8):
        codes = codes_of(count, truth, seed)
        found, _ = shrunk_covariance(codes, target)
        own = torch.cov(codes.mean.T, correction=0)
        gains.append(expected(found, truth) - expected(own, truth))
    assert sum(gains) > 0


def expected(covariance, truth):
    return -0.5 * float(torch.logdet(covariance) + torch.linalg.solve(covariance, truth).trace())


@pytest.mark.parametrize("least", [0.1, 0.5, 1.0])
def test_no_less_of_the_target_than_is_asked_for(truth, least):
    _, share = shrunk_covariance(codes_of(5000, truth, 0), torch.eye(SIZE), least)
    assert share == least


def test_widths_of_the_codes_count():
    """Points in one place with a width of one have the unit covariance."""
    codes = Codes(torch.zeros(30, SIZE), torch.ones(30, SIZE), torch.arange(30))
    found, _ = shrunk_covariance(codes, torch.eye(SIZE))
    torch.testing.assert_close(found, torch.eye(SIZE, dtype=torch.float64))


def test_the_result_lies_between_both(truth):
    codes = codes_of(40, truth, 1)
    target = torch.eye(SIZE)
    found, share = shrunk_covariance(codes, target)
    own = torch.cov(codes.mean.T, correction=0)
    assert share in SHARES
    torch.testing.assert_close(found, (1 - share) * own + share * target.double())
