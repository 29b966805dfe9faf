"""Pruning: the field and the base of live dimensions are those of the whole networks with dead ones at their mean."""

import numpy as np
import pytest
import torch

from model.errors import InvalidParameter
from model.networks.decoder import DecoderShape
from model.networks.flow import FlowShape
from model.networks.prior import PriorShape
from tests.random_networks import randomise
from training.autodecoder import AutoDecoder
from training.choices import LEAST_MOVEMENT, LEAST_OF_TRAINING
from training.config import ObjectiveConfig, TrainingConfig
from training.pruning import PriorParts, divergences, gaussian_codes, pruned, refitted
from training.shrinkage import shrunk_covariance

SIZE, SHAPES = 6, 20
LIVE = [0, 2, 3, 5]


def module_of(*, transforms=1, objective="variational", live=LIVE, seed=0, ard=True, shapes=SHAPES):
    """A random module whose codes say nothing along the other dimensions."""
    torch.manual_seed(seed)
    config = TrainingConfig(
        decoder=DecoderShape(latent_size=SIZE, width=16, depth=3),
        prior=PriorShape(FlowShape(latent_size=SIZE, transforms=transforms, bins=3, width=12), use_ard=ard),
        objective=ObjectiveConfig(name=objective),
    )
    module = AutoDecoder(config, shapes)
    randomise(module.prior.flow, seed, 0.4)
    with torch.no_grad():
        module.prior.log_sigma.copy_(torch.linspace(-1.0, 0.5, SIZE))
        module.mean.normal_()
        module.log_deviation.fill_(-2.0 if objective == "variational" else -3.0)
        dead = [number for number in range(SIZE) if number not in live]
        module.mean[:, dead] = 1e-3
        module.log_deviation[:, dead] = 0.0
    return module.eval()


def module_of_points(**parts):
    """The same, whose codes are points."""
    return module_of(objective="paper", **parts)


def filled(less, codes, centre):
    """Live codes among dead dimensions at their mean."""
    whole = centre.expand(len(codes), -1).clone()
    whole[:, torch.from_numpy(less.live)] = codes
    return whole


@torch.no_grad()
@pytest.mark.parametrize("seed", range(3))
def test_the_field_is_that_of_the_whole_decoder_with_dead_dimensions_at_their_mean(seed):
    module = module_of_points(seed=seed)
    less = pruned(module)
    assert less.live.tolist() == LIVE
    codes, points = torch.randn(4, len(LIVE)), 20.0 * torch.randn(4, 30, 3)
    whole = module.decoder(filled(less, codes, module.code_means().mean(dim=0)), points)
    torch.testing.assert_close(less.decoder(codes, points), whole, atol=1e-5, rtol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("seed", range(3))
def test_one_transform_keeps_base_and_density_of_live_dimensions(seed):
    """With dead dimensions at their mean the whole density is the pruned one plus that of the dead, a conditional."""
    module = module_of_points(seed=seed)
    less = pruned(module)
    codes = 0.5 * torch.randn(5, len(LIVE))
    whole = filled(less, codes, module.code_means().mean(dim=0))
    kept = torch.from_numpy(less.live)
    torch.testing.assert_close(
        less.prior.to_base(codes)[0], module.prior.to_base(whole)[0][:, kept], atol=1e-5, rtol=1e-5
    )
    jacobian = module.prior.base_jacobian(whole)[1][:, kept][:, :, kept]
    torch.testing.assert_close(less.prior.base_jacobian(codes)[1], jacobian, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(less.prior.from_base(less.prior.to_base(codes)[0]), codes, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_the_density_integrates_to_one_over_the_live_dimensions():
    module = module_of_points(transforms=2, live=[1])
    less = pruned(module)
    places = torch.linspace(-20.0, 20.0, 40001)[:, None]
    total = float(less.prior.log_density(places).exp().sum() * (places[1] - places[0]))
    assert total == pytest.approx(1.0, abs=1e-3)


@torch.no_grad()
def test_what_two_transforms_change_is_measured():
    module = module_of_points(transforms=2)
    less = pruned(module)
    kept = torch.from_numpy(less.live)
    whole = module.prior.to_base(module.code_means())[0][:, kept] / module.prior.sigma[kept]
    change = (less.prior.to_base(less.codes)[0] / less.prior.sigma - whole).abs().max()
    assert less.base_change == pytest.approx(float(change), rel=1e-5)
    assert less.facts()["largest_base_change_in_sigmas"] == less.base_change


@torch.no_grad()
def test_without_dead_dimensions_nothing_changes():
    module = module_of_points(transforms=2, live=list(range(SIZE)))
    less = pruned(module)
    assert less.live.tolist() == list(range(SIZE))
    assert less.base_change < 1e-5
    codes = torch.randn(3, SIZE)
    torch.testing.assert_close(less.prior.log_density(codes), module.prior.log_density(codes), atol=1e-4, rtol=1e-5)


def test_divergences_are_those_of_gaussians():
    module = module_of()
    found = divergences(module)
    mean = module.mean.detach().numpy()
    expected = 0.5 * (np.exp(-4.0) + (mean**2).mean(axis=0) - 1.0) + 2.0
    np.testing.assert_allclose(found[LIVE], expected[LIVE], rtol=1e-4)
    np.testing.assert_allclose(found[[1, 4]], 0.0, atol=1e-5)


def test_points_are_judged_by_their_spread():
    less = pruned(module_of_points())
    assert less.live.tolist() == LIVE
    assert np.isnan(less.nats).all()


def test_gaussians_keep_all_dimensions():
    less = pruned(module_of(live=[]))
    assert less.live.tolist() == list(range(SIZE))
    assert less.base_change == 0.0


@pytest.mark.filterwarnings("ignore:std")
def test_the_point_of_a_single_shape_is_refused():
    with pytest.raises(InvalidParameter, match="at least one live one"):
        pruned(module_of_points(shapes=1))


HALF_MM = (20.0, 20.0, 20.0)


class TestRefitted:
    @torch.no_grad()
    def test_the_base_is_the_standard_normal_of_the_codes(self):
        module = module_of(live=list(range(SIZE)))
        found = refitted(module, SHAPES, HALF_MM, PriorParts(flow=False))
        base, means = found.prior.to_base(found.codes)[0] / found.prior.sigma, module.code_means()
        torch.testing.assert_close(base.mean(dim=0), torch.zeros(base.shape[1]), atol=1e-4, rtol=0.0)
        covariance, share = shrunk_covariance(*gaussian_codes(module, SHAPES))
        assert found.shrinkage == share
        turn = torch.linalg.lstsq(means - means.mean(dim=0), base).solution.double()
        torch.testing.assert_close(
            turn.T @ covariance @ turn, torch.eye(base.shape[1], dtype=torch.float64), atol=1e-3, rtol=0.0
        )
        assert (found.prior.sigma.diff() <= 0).all()
        assert found.facts()["fitted"] == {
            "flow": False,
            "ard": True,
            "least_movement": LEAST_MOVEMENT,
            "least_of_training": LEAST_OF_TRAINING,
            "keep_centre": False,
        }

    def test_the_field_is_that_of_the_trained_decoder_at_the_same_codes(self):
        module = module_of()
        found = refitted(module, SHAPES, HALF_MM, PriorParts(ard=False))
        points = 20.0 * torch.randn(SHAPES, 30, 3)
        with torch.no_grad():
            expected = module.decoder(module.code_means(), points)
            torch.testing.assert_close(found.decoder(found.codes, points), expected, atol=5e-3, rtol=1e-3)

    def test_without_relevance_all_dimensions_stay(self):
        found = refitted(module_of(), SHAPES, HALF_MM, PriorParts(ard=False))
        assert found.live.tolist() == list(range(SIZE))
        assert len(found.prior.sigma) == SIZE
        assert found.facts()["rule"] == "all"

    def test_with_relevance_only_what_moves_the_surface_stays(self):
        module = module_of(ard=False)
        with torch.no_grad():
            for part in (module.prior.log_sigma, module.log_deviation):
                part[..., [1, 4]] = -9.0
            module.mean[:, [1, 4]] *= 1e-4
        found = refitted(module, SHAPES, HALF_MM)
        sigma = found.prior.sigma
        assert len(sigma) == len(LIVE)
        assert float(sigma.min()) >= LEAST_MOVEMENT * float(sigma.max())
        fewer = refitted(module, SHAPES, HALF_MM, PriorParts(least_movement=float(sigma[1] / sigma[0]) - 1e-3))
        torch.testing.assert_close(fewer.prior.sigma, sigma[:2])
        assert f"{fewer.fitted.least_movement:g} of the largest" in fewer.facts()["rule"]

    def test_all_of_the_prior_and_all_dimensions_are_the_trained_model(self):
        """What a run says nothing of along a dimension may still be what another shape needs."""
        module = module_of(ard=False)
        parts = PriorParts(flow=False, least_movement=0.0, least_of_training=1.0, keep_centre=True)
        found = refitted(module, SHAPES, HALF_MM, parts)
        assert found.facts()["rule"] == "all"
        assert found.live.tolist() == list(range(SIZE))
        turned = found.codes / found.prior.sigma
        trained = module.code_means() / module.prior.sigma
        torch.testing.assert_close(turned @ turned.T, trained @ trained.T, atol=1e-3, rtol=1e-3)

    @pytest.mark.parametrize(
        ("flow", "bent", "there"), [(True, True, True), (False, True, False), (True, False, False)]
    )
    def test_a_flow_is_there_when_it_is_asked_for_and_has_something_to_say(self, flow, bent, there):
        module = module_of(shapes=200)
        if bent:
            with torch.no_grad():
                module.mean[:, 2] = module.mean[:, 0].square() - 1.0
                module.mean[:, 5] = module.mean[:, 3].square() - 1.0
        found = refitted(module, 200, HALF_MM, PriorParts(flow=flow))
        assert found.prior.shape.use_flow is there
        assert (found.flow_gain > 0.0) is there

    def test_half_of_a_prior_that_stood_still_stays(self):
        module = module_of(ard=False)
        assert refitted(module, SHAPES, HALF_MM).shrinkage >= LEAST_OF_TRAINING
        assert refitted(module, SHAPES, HALF_MM, PriorParts(least_of_training=1.0)).shrinkage == 1.0

    def test_points_are_only_pruned(self):
        found = refitted(module_of_points(), SHAPES, HALF_MM)
        assert (found.fitted, found.live.tolist()) == (None, LIVE)
