"""A flow fitted to codes: it learns what codes share, and never what it cannot show on held-out ones."""

import torch

from model.networks.flow import FlowShape
from model.networks.prior import LatentPrior, PriorShape
from training.prior_fit import HELD_EVERY, Background, Codes, fitted_prior

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
    """So little that the flow is not kept: distances between codes stay what they are."""
    codes = codes_of(torch.randn(60, 2, generator=torch.Generator().manual_seed(3)))
    fitted, gain = fitted_prior(prior_of(), codes)
    assert gain == 0.0
    assert not fitted.shape.use_flow
    with torch.no_grad():
        torch.testing.assert_close(fitted.to_base(codes.mean)[0], codes.mean)


def test_a_base_that_was_widened_on_purpose_stays_wide():
    """Codes of half the base's width, and a background that makes the whole as wide as the base."""
    narrow = codes_of(0.5 * torch.randn(200, 2, generator=torch.Generator().manual_seed(3)), deviation=0.0)
    background = Background(0.5, 1.32 * torch.diag(SIGMA))  # 0.5 (0.25 + 1.75) = 1
    fitted = {
        name: fitted_prior(prior_of(), narrow, one)[0] for name, one in (("alone", None), ("widened", background))
    }
    base = SIGMA * torch.randn(2000, 2, generator=torch.Generator().manual_seed(5))
    with torch.no_grad():
        spread = {name: prior.from_base(base).std(dim=0) / SIGMA for name, prior in fitted.items()}
    assert (spread["alone"] < 0.75).all()
    assert (spread["widened"] > 0.85).all()


def test_a_background_takes_its_share_of_the_draws():
    random = torch.Generator().manual_seed(0)
    draws = Background(0.3, torch.diag(SIGMA)).mixed_with(torch.full((4000, 2), 50.0), random)
    mixed = draws[:, 0] < 25.0
    assert abs(mixed.float().mean() - 0.3) < 0.03
    torch.testing.assert_close(draws[mixed].std(dim=0), SIGMA, rtol=0.1, atol=0.0)


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
