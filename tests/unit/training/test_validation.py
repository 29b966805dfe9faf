from dataclasses import replace

import pytest
import torch

from model.networks.decoder import DecoderShape
from model.networks.flow import FlowShape
from model.networks.prior import PriorShape
from tests.ellipsoid_cohort import cohort, ellipsoid_points, ellipsoids
from training.autodecoder import Trainer
from training.config import TrainingConfig
from training.validation import Validation

CONFIG = TrainingConfig(
    decoder=DecoderShape(latent_size=3, width=24, depth=2, extent_mm=14.0),
    prior=PriorShape(FlowShape(latent_size=3, transforms=1, bins=3, width=6)),
    steps=250,
    batch_shapes=5,
    near_points=64,
    far_points=24,
    warm_up=0.0,
)


def held_out():
    return [ellipsoid_points(shape) for shape in ellipsoids(3, seed=99)]


def train(validate_every: int = 0, steps: int = 12):
    trainer, validation = Trainer.start(CONFIG, cohort()), Validation(CONFIG, held_out())
    for step in range(1, steps + 1):
        trainer.advance()
        if validate_every and step % validate_every == 0:
            validation.figures(trainer.module)
    return trainer


def test_training_is_the_same_with_and_without_it():
    torch.manual_seed(0)
    without, after_without = train().module.state_dict(), torch.rand(1)
    torch.manual_seed(0)
    with_it, after_with = train(validate_every=3).module.state_dict(), torch.rand(1)
    assert all(torch.equal(value, with_it[name]) for name, value in without.items())
    assert torch.equal(after_without, after_with)


def test_the_module_is_left_as_it_was():
    trainer = train(steps=1)
    before = {name: value.clone() for name, value in trainer.module.state_dict().items()}
    gradients = [None if p.grad is None else p.grad.clone() for p in trainer.module.parameters()]
    Validation(CONFIG, held_out()).figures(trainer.module)
    assert all(torch.equal(value, before[name]) for name, value in trainer.module.state_dict().items())
    for parameter, gradient in zip(trainer.module.parameters(), gradients, strict=True):
        assert parameter.requires_grad
        assert (parameter.grad is None and gradient is None) or torch.equal(parameter.grad, gradient)


def test_figures_repeat_and_depend_on_the_seed():
    module, shapes = train(steps=3).module, held_out()
    one, again = (Validation(CONFIG, shapes).figures(module) for _ in range(2))
    other = Validation(replace(CONFIG, seed=1), shapes).figures(module)
    assert one == again
    assert one != other


def test_figures_tell_a_trained_module_from_a_fresh_one():
    validation = Validation(CONFIG, held_out())
    fresh = validation.figures(Trainer.start(CONFIG, cohort()).module)
    trained = validation.figures(train(steps=CONFIG.steps).module)
    assert trained["validation/cross_entropy"] < 0.6 * fresh["validation/cross_entropy"]
    assert 1.0 >= trained["validation/dice"] > fresh["validation/dice"]


def test_under_a_heavy_prior_the_codes_stay_at_its_mode():
    heavy = replace(CONFIG, objective=replace(CONFIG.objective, lambda_flow=1e4))
    module = Trainer.start(CONFIG, cohort()).module
    figures = Validation(heavy, held_out()).figures(module)
    mode = -module.prior.log_density(torch.zeros(1, 3)).item()
    assert figures["validation/negative_log_density"] == pytest.approx(mode, abs=0.1)
    assert Validation(CONFIG, held_out()).figures(module)["validation/negative_log_density"] > mode + 0.3
