import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from torch import Tensor

from model.networks.decoder import DecoderShape
from model.networks.flow import FlowShape
from model.networks.prior import PriorShape
from tests.random_networks import jacobian, randomise
from training.autodecoder import AutoDecoder
from training.config import ObjectiveConfig, TrainingConfig, config_from_dict
from training.objective import cross_entropy_loss, gaussian_entropy, reconstruction_loss, soft_dice_loss, unevenness
from training.samples import Batch

CONFIG = TrainingConfig(
    decoder=DecoderShape(latent_size=3, width=8, depth=2, extent_mm=10.0),
    prior=PriorShape(FlowShape(latent_size=3, transforms=2, bins=3, width=6)),
)
PAPER = ObjectiveConfig(name="paper", reconstruction="dice", lambda_flow=0.02, lambda_ard=0.003, a=1.7, b=0.4)
OBJECTIVES = [PAPER, *(ObjectiveConfig(name=name) for name in ("denoising", "centred", "variational"))]


def module_of(config: TrainingConfig, shapes: int = 5) -> AutoDecoder:
    torch.manual_seed(3)
    module = AutoDecoder(config, shapes)
    randomise(module.prior.flow, 0, 0.4)
    with torch.no_grad():
        module.mean.normal_()
        if config.prior.use_ard:
            module.prior.log_sigma.copy_(torch.tensor([-0.5, 0.1, 0.4]))
    return module


def batch_of(shapes: int, points: int = 11) -> Batch:
    random = torch.Generator().manual_seed(1)
    weights = torch.rand(shapes, points, generator=random)
    return Batch(
        10.0 * torch.randn(shapes, points, 3, generator=random),
        (torch.rand(shapes, points, generator=random) < 0.4).float(),
        weights / weights.sum(dim=1, keepdim=True),
    )


def direct_dice(logits: Tensor, labels: Tensor, weights: Tensor) -> float:
    """Soft Dice loss of one shape, point by point."""
    above = below = 0.0
    for logit, label, weight in zip(logits.tolist(), labels.tolist(), weights.tolist(), strict=True):
        probability = 1.0 / (1.0 + math.exp(-logit))
        above += 2.0 * weight * probability * label
        below += weight * (probability + label)
    return 1.0 - above / below


class TestReconstruction:
    def test_dice_is_that_of_a_direct_sum(self):
        batch = batch_of(4)
        logits = 3.0 * torch.randn(4, 11, generator=torch.Generator().manual_seed(2))
        found = soft_dice_loss(logits, batch.labels, batch.weights)
        expected = [direct_dice(*row) for row in zip(logits, batch.labels, batch.weights, strict=True)]
        assert found.tolist() == pytest.approx(expected, abs=1e-5)

    @given(st.integers(0, 1000), st.floats(0.1, 50.0))
    def test_dice_lies_between_0_and_1_and_does_not_depend_on_the_scale_of_weights(self, seed, scale):
        batch = batch_of(2)
        logits = 4.0 * torch.randn(2, 11, generator=torch.Generator().manual_seed(seed))
        found = soft_dice_loss(logits, batch.labels, batch.weights)
        assert ((found >= 0) & (found <= 1)).all()
        torch.testing.assert_close(
            soft_dice_loss(logits, batch.labels, scale * batch.weights), found, atol=1e-4, rtol=0
        )

    def test_both_losses_vanish_for_a_perfect_answer_and_are_large_for_its_opposite(self):
        batch = batch_of(3)
        right = 60.0 * (2.0 * batch.labels - 1.0)
        for loss in (soft_dice_loss, cross_entropy_loss):
            assert loss(right, batch.labels, batch.weights).abs().max() < 1e-5
            assert loss(-right, batch.labels, batch.weights).min() > 0.99

    def test_cross_entropy_is_the_weighted_negative_log_likelihood(self):
        batch = batch_of(3)
        logits = torch.randn(3, 11, generator=torch.Generator().manual_seed(2))
        likelihood = torch.distributions.Bernoulli(logits=logits).log_prob(batch.labels)
        expected = -(batch.weights * likelihood).sum(dim=1)
        torch.testing.assert_close(cross_entropy_loss(logits, batch.labels, batch.weights), expected)

    def test_the_losses_are_selectable_alone_and_together(self):
        batch = batch_of(3)
        logits = torch.randn(3, 11, generator=torch.Generator().manual_seed(2))
        dice, entropy, both = (
            reconstruction_loss(name, logits, batch.labels, batch.weights) for name in ("dice", "bce", "bce_dice")
        )
        torch.testing.assert_close(dice, soft_dice_loss(logits, batch.labels, batch.weights))
        torch.testing.assert_close(entropy, cross_entropy_loss(logits, batch.labels, batch.weights))
        torch.testing.assert_close(both, dice + entropy)


class TestUnevenness:
    """Planes at x = 0 with a logistic profile: what moves them sweeps the same everywhere on them."""

    @staticmethod
    def swept(moves, points=4000):
        x = 6.0 * torch.rand(len(moves), points, generator=torch.Generator().manual_seed(0)) - 3.0
        moved = 4.0 * torch.tensor(moves)[:, None].expand_as(x)  # slope times movement
        return unevenness(-4.0 * x, moved, torch.full_like(x, 1.0 / points)).item()

    def test_equal_movements_are_even_whatever_their_direction(self):
        assert self.swept([0.3, -0.3, 0.3, 0.3]) == pytest.approx(0.0, abs=2e-3)

    def test_it_is_the_variance_of_movements_relative_to_their_mean(self):
        moves = np.array([0.1, 0.2, 0.3, 0.4])
        assert self.swept(moves.tolist()) == pytest.approx(moves.var() / moves.mean() ** 2, abs=0.01)

    def test_few_points_add_scatter_but_nothing_on_average(self):
        random = torch.Generator().manual_seed(1)
        found = []
        for _ in range(400):
            x = 6.0 * torch.rand(8, 32, generator=random) - 3.0
            found.append(unevenness(-4.0 * x, torch.ones_like(x), torch.ones_like(x)).item())
        assert abs(np.mean(found)) < 3.0 * np.std(found) / 20.0 + 0.01

    def test_a_decoder_that_does_not_move_yet_has_a_finite_one(self):
        assert self.swept([0.0, 0.0]) == pytest.approx(1.0)


def test_entropy_is_that_of_a_diagonal_gaussian():
    log_deviation = torch.randn(4, 6, generator=torch.Generator().manual_seed(0))
    gaussian = torch.distributions.Independent(torch.distributions.Normal(torch.zeros(4, 6), log_deviation.exp()), 1)
    torch.testing.assert_close(gaussian_entropy(log_deviation), gaussian.entropy())


class TestPaperObjective:
    @pytest.mark.parametrize("standardise", [False, True])
    def test_it_is_dice_minus_log_density_plus_ard(self, standardise):
        config = replace(CONFIG, objective=PAPER, prior=replace(CONFIG.prior, standardise=standardise))
        module, chosen = module_of(config), torch.tensor([4, 0, 2])
        batch = batch_of(3)
        with torch.no_grad():
            codes = module.mean[chosen]
            logits = module.decoder(codes, batch.points)
            base, _ = module.prior.to_base(codes)
            sigma = module.prior.log_sigma.exp().numpy().astype(float)
        dice = [direct_dice(*row) for row in zip(logits, batch.labels, batch.weights, strict=True)]
        volume = np.linalg.slogdet(jacobian(lambda z: module.prior.to_base(z)[0], codes).numpy())[1]
        gaussian = stats.multivariate_normal(np.zeros(3), np.diag(sigma**2)).logpdf(base.numpy())
        alpha = 1.0 / sigma**2
        ard = np.sum(-(1.7 - 1.0) * np.log(alpha) + 0.4 * alpha)
        expected = np.mean(dice) + 0.02 * np.mean(-(gaussian + volume)) + 0.003 * ard
        terms = module.loss(chosen, batch, torch.Generator())
        assert terms["loss"].item() == pytest.approx(expected, abs=1e-5)
        assert terms["reconstruction"].item() == pytest.approx(np.mean(dice), abs=1e-5)
        assert terms["prior"].item() == pytest.approx(-np.mean(gaussian + volume), abs=1e-4)
        assert terms["ard"].item() == pytest.approx(ard, abs=1e-4)

    def test_codes_are_points(self):
        module = module_of(replace(CONFIG, objective=PAPER))
        found = module.draw_codes(torch.tensor([1, 3]), torch.Generator())
        assert torch.equal(found, module.mean[[1, 3]])

    def test_every_part_learns(self):
        module = module_of(replace(CONFIG, objective=PAPER))
        module.loss(torch.arange(5), batch_of(5), torch.Generator())["loss"].backward()
        still = {name for name, parameter in module.named_parameters() if parameter.grad is None}
        assert still == {"log_deviation"}


class TestVariationalObjective:
    def test_divergence_to_a_gaussian_prior_is_the_exact_one_on_average(self):
        config = replace(CONFIG, prior=replace(CONFIG.prior, use_flow=False))
        module, draws = module_of(config, shapes=2), 40_000
        with torch.no_grad():
            module.log_deviation.copy_(torch.tensor([[-1.0, 0.2, -0.4], [0.3, -2.0, 0.0]]))
            sigma = module.prior.sigma
            posterior = torch.distributions.Normal(sigma * module.mean, sigma * module.log_deviation.exp())
            prior = torch.distributions.Normal(torch.zeros(3), module.prior.sigma)
            expected = torch.distributions.kl_divergence(posterior, prior).sum(dim=1)
            for shape in range(2):
                chosen = torch.full((draws,), shape)
                batch = Batch(torch.zeros(draws, 1, 3), torch.zeros(draws, 1), torch.ones(draws, 1))
                codes = module.draw_codes(chosen, torch.Generator().manual_seed(0))
                error = module.prior.log_density(codes).std().item() / draws**0.5
                found = module.loss(chosen, batch, torch.Generator().manual_seed(0))["prior"]
                assert abs(found.item() - expected[shape].item()) < 4 * error
                assert error < 0.05 * expected[shape].item()

    @pytest.mark.parametrize("objective", OBJECTIVES[1:])
    def test_codes_are_drawn_from_their_gaussians(self, objective):
        module = module_of(replace(CONFIG, objective=objective))
        codes = module.draw_codes(torch.full((20_000,), 2), torch.Generator().manual_seed(0)).detach()
        unit = module.prior.sigma if objective.name == "variational" else torch.ones(3)
        deviation = (unit * module.log_deviation[2].exp()).detach()
        torch.testing.assert_close(codes.mean(dim=0), module.code_means()[2].detach(), atol=0.01, rtol=0)
        torch.testing.assert_close(codes.std(dim=0), deviation, atol=0.01, rtol=0)

    def test_the_divergence_leaves_the_sigmas_alone(self):
        module = module_of(CONFIG)
        module.loss(torch.arange(5), batch_of(5), torch.Generator().manual_seed(0))["prior"].backward()
        torch.testing.assert_close(module.prior.log_sigma.grad, torch.zeros(3), atol=1e-5, rtol=0)

    def test_a_dimension_without_spread_moves_no_logit(self):
        module, points = module_of(CONFIG), batch_of(1).points
        with torch.no_grad():
            module.prior.log_sigma[1] = -20.0
            one, other = module.code_means()[:1], module.code_means()[:1].clone()
            other[:, 1] = 0.0
            torch.testing.assert_close(module.decoder(one, points), module.decoder(other, points))

    @pytest.mark.parametrize("objective", OBJECTIVES[1:])
    def test_every_part_learns(self, objective):
        module = module_of(replace(CONFIG, objective=objective))
        module.loss(torch.arange(5), batch_of(5), torch.Generator())["loss"].backward()
        still = {name for name, parameter in module.named_parameters() if parameter.grad is None}
        assert still == ({"log_deviation"} if objective.name == "denoising" else set())


class TestAblations:
    def terms(self, config):
        module = module_of(config)
        return module, module.loss(torch.arange(5), batch_of(5), torch.Generator().manual_seed(0))

    @pytest.mark.parametrize("objective", OBJECTIVES)
    def test_without_ard_the_gamma_prior_is_left_out_and_sigma_stays(self, objective):
        config = replace(CONFIG, objective=objective, prior=replace(CONFIG.prior, use_ard=False))
        module, terms = self.terms(config)
        expected = terms["reconstruction"] + objective.lambda_flow * terms["prior"]
        assert module.pressure.item() == 1.0
        torch.testing.assert_close(terms["loss"], expected)
        terms["loss"].backward()
        assert module.prior.log_sigma.grad is None
        torch.testing.assert_close(module.prior.sigma, torch.full((3,), config.prior.initial_sigma))

    def test_without_flow_only_the_gaussian_is_left(self):
        config = replace(CONFIG, objective=PAPER, prior=replace(CONFIG.prior, use_flow=False))
        module, terms = self.terms(config)
        gaussian = torch.distributions.Normal(torch.zeros(3), module.prior.sigma)
        torch.testing.assert_close(terms["prior"], -gaussian.log_prob(module.mean).sum(dim=1).mean())

    def test_weights_of_zero_leave_the_reconstruction(self):
        config = replace(CONFIG, objective=replace(PAPER, lambda_flow=0.0, lambda_ard=0.0))
        _, terms = self.terms(config)
        assert torch.equal(terms["loss"], terms["reconstruction"])

    @pytest.mark.parametrize("objective", OBJECTIVES)
    def test_a_configuration_survives_being_written_down(self, objective):
        config = replace(CONFIG, objective=objective, prior=replace(CONFIG.prior, use_flow=False, use_ard=False))
        assert config_from_dict(config.as_dict()) == config
