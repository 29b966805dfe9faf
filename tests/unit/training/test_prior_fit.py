"""A flow fitted to codes: it learns what codes share, and never what it cannot show on held-out ones."""

import torch

from model.networks.flow import FlowShape
from model.networks.prior import LatentPrior, PriorShape
from training.prior_fit import HELD_EVERY, Codes, fitted_prior

SIGMA = torch.tensor([2.0, 0.1])


def prior_of(*, use_flow=True):
    prior = LatentPrior(PriorShape(FlowShape(latent_size=2, transforms=2, bins=4, width=16), use_flow=use_flow))
    prior.log_sigma.data.copy_(SIGMA.log())
    return prior


def codes_of(mean, deviation=0.05):
    return Codes(SIGMA * mean, SIGMA * deviation * torch.ones_like(mean), torch.arange(len(mean)))


def banana(count, seed=0):
    """The second coordinate follows the square of the first, in units of the sigmas."""
    random = torch.Generator().manual_seed(seed)
    first, rest = torch.randn(2, count, generator=random)
    return torch.stack([first, (first.square() - 1.0) / 2.0**0.5 + 0.2 * rest], dim=1)


def test_what_codes_share_is_learned_and_holds_for_others():
    fitted, gain = fitted_prior(prior_of(), codes_of(banana(200)))
    assert gain > 0.5
    with torch.no_grad():
        fresh = SIGMA * banana(200, seed=7)
        assert fitted.log_density(fresh).mean() > prior_of().log_density(fresh).mean() + 0.5


def test_codes_of_the_gaussian_itself_leave_little_to_learn():
    _, gain = fitted_prior(prior_of(), codes_of(torch.randn(60, 2, generator=torch.Generator().manual_seed(3))))
    assert 0.0 <= gain < 0.2


def test_sigmas_stay_and_the_inverse_undoes_the_flow():
    fitted, _ = fitted_prior(prior_of(), codes_of(banana(100)))
    torch.testing.assert_close(fitted.sigma, SIGMA)
    with torch.no_grad():
        codes = SIGMA * banana(20, seed=5)
        torch.testing.assert_close(fitted.from_base(fitted.to_base(codes)[0]), codes, atol=1e-4, rtol=1e-4)


def test_the_same_codes_give_the_same_prior():
    one, other = (fitted_prior(prior_of(), codes_of(banana(60)))[0].state_dict() for _ in range(2))
    assert all(torch.equal(value, other[name]) for name, value in one.items())


def test_without_a_flow_or_anything_to_hold_out_the_base_stays():
    few = codes_of(banana(HELD_EVERY - 1))
    alone = Codes(few.mean, few.deviation, torch.zeros(len(few.mean), dtype=torch.long))
    for prior, codes in ((prior_of(use_flow=False), codes_of(banana(50))), (prior_of(), alone)):
        fitted, gain = fitted_prior(prior, codes)
        assert gain == 0.0
        with torch.no_grad():
            torch.testing.assert_close(fitted.to_base(codes.mean)[0], codes.mean)
