"""What the options of the commands become."""

import pytest

from model.errors import InvalidParameter
from training.choices import (
    DeviceName,
    ObjectiveName,
    RegimeName,
    TrainingChoice,
    configured,
    with_batches,
    with_duration,
)
from training.config import TrainingConfig


def chosen(objective=ObjectiveName.VARIATIONAL, **more):
    return TrainingChoice(objective, RegimeName.THICK, 16, seed=3, device=DeviceName.CPU, **more)


def built(objective=ObjectiveName.VARIATIONAL, flow=True, ard=True, **more):
    return configured(chosen(objective, flow=flow, ard=ard, **more), reflected=True)


def test_options_reach_the_configuration():
    config = built(flow=False, ard=False)
    assert (config.regime, config.seed, config.device) == ("thick", 3, "cpu")
    assert config.decoder.latent_size == config.prior.flow.latent_size == 16
    assert not config.prior.use_flow
    assert not config.prior.use_ard


@pytest.mark.parametrize("objective", list(ObjectiveName))
def test_the_weight_of_relevance_determination_is_a_choice(objective):
    assert built(objective, ard_weight=7e-5).objective.lambda_ard == 7e-5
    assert built(objective).objective.lambda_ard == 1e-4


def test_a_weight_of_relevance_determination_that_does_not_act_is_refused():
    for ard in (False, None):
        with pytest.raises(InvalidParameter, match="--ard-weight would do nothing; it is accepted with --ard"):
            chosen(ard=ard, ard_weight=7e-5)
    assert built(ObjectiveName.CENTRED, ard=None, ard_weight=7e-5).objective.lambda_ard == 7e-5


def test_steps_and_epochs_exclude_each_other():
    with pytest.raises(InvalidParameter, match="one of them is accepted") as caught:
        chosen(steps=10, epochs=2)
    assert caught.value.part == "epochs"


@pytest.mark.parametrize("objective", list(ObjectiveName))
def test_a_prior_is_trained_along_unless_it_is_fitted_afterwards(objective):
    together = objective is not ObjectiveName.VARIATIONAL
    assert (chosen(objective).use_flow, chosen(objective).use_ard) == (together, together)
    for said in (True, False):
        assert chosen(objective, flow=said).use_flow is said
        assert chosen(objective, ard=said).use_ard is said


def test_the_paper_is_selectable_as_written():
    config = built(ObjectiveName.PAPER)
    assert (config.objective.name, config.objective.reconstruction) == ("paper", "dice")
    assert config.batch_shapes == 6
    assert not config.prior.standardise
    assert not config.decoder.unit_columns


@pytest.mark.parametrize(("shapes", "batch", "points"), [(15, 32, 256), (286, 71, 115), (5000, 128, 64)])
def test_large_cohorts_have_more_shapes_and_fewer_points_in_a_step(shapes, batch, points):
    config = with_batches(TrainingConfig(), shapes)
    assert config.batch_shapes == batch
    assert points - 2 <= config.near_points + config.far_points <= points


def test_the_papers_batches_stay():
    config = built(ObjectiveName.PAPER)
    assert with_batches(config, 5000) == config


@pytest.mark.parametrize(("shapes", "batch", "steps"), [(12, 6, 30), (13, 6, 45), (4, 6, 15)])
def test_an_epoch_sees_every_shape(shapes, batch, steps):
    config = with_duration(TrainingConfig(batch_shapes=batch), None, 15, shapes)
    assert config.steps == steps
