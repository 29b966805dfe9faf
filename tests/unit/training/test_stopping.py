import signal
from dataclasses import replace

import pytest
import torch

from model.networks.decoder import DecoderShape
from model.networks.flow import FlowShape
from model.networks.prior import PriorShape
from tests.ellipsoid_cohort import cohort
from training.autodecoder import Trainer, train
from training.config import TrainingConfig
from training.stopping import BEST, EarlyStopping

SMALL = TrainingConfig(
    decoder=DecoderShape(latent_size=3, width=8, depth=2, extent_mm=20.0),
    prior=PriorShape(FlowShape(latent_size=3, transforms=1, width=4)),
    steps=40,
    batch_shapes=2,
    near_points=8,
    far_points=8,
    validate_every=2,
    patience=2,
)


def run(folder, values, config=SMALL, start_at=0):
    """Train with these validation figures in place of measured ones; the modules seen at each validation."""
    trainer = Trainer.start(config, cohort(4))
    if start_at:
        trainer.load(folder / "checkpoint.pt")
    folder.mkdir(exist_ok=True)
    stopping = EarlyStopping(trainer, folder)
    seen = {}

    def watch(step, _figures):
        if step % config.validate_every == 0 or step == config.steps:
            seen[step] = {name: value.clone() for name, value in trainer.module.state_dict().items()}
            stopping.see({"validation/cross_entropy": values(step)})

    train(trainer, folder, watch)
    return trainer, seen


@pytest.mark.usefixtures("keyboard")
def test_an_interrupt_at_the_step_that_ends_a_run_does_not_stop_it(tmp_path):
    def values(step):
        if step == 14:
            signal.raise_signal(signal.SIGINT)
        return abs(step - 10) + 1.0

    trainer, _ = run(tmp_path / "run", values)
    assert trainer.finished
    assert trainer.step == 14


def same(module, state):
    return all(torch.equal(value, state[name]) for name, value in module.state_dict().items())


def test_a_run_ends_when_nothing_better_follows_and_holds_its_best_module(tmp_path):
    trainer, seen = run(tmp_path / "run", lambda step: abs(step - 10) + 1.0)
    assert trainer.step == 14
    assert same(trainer.module, seen[10])
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert state["finished"]
    assert all(torch.equal(state["module"][name], value) for name, value in seen[10].items())


def test_a_run_that_always_improves_reaches_its_last_step(tmp_path):
    trainer, seen = run(tmp_path / "run", lambda step: 1.0 / step)
    assert trainer.step == 40
    assert same(trainer.module, seen[40])


def test_without_patience_nothing_is_stopped_put_back_or_kept(tmp_path):
    trainer, seen = run(tmp_path / "run", float, replace(SMALL, patience=0))
    assert trainer.step == 40
    assert same(trainer.module, seen[40])
    assert not (tmp_path / "run" / BEST).exists()


def test_what_was_best_before_a_kill_is_still_best_after_it(tmp_path):
    config = replace(SMALL, checkpoint_every=6)

    def killed(step):
        if step == 8:
            raise KeyboardInterrupt
        return abs(step - 4) + 1.0

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "run", killed, config)
    trainer, _ = run(tmp_path / "run", lambda step: abs(step - 4) + 1.0, config, start_at=6)
    unbroken, _ = run(tmp_path / "other", lambda step: abs(step - 4) + 1.0, config)
    assert trainer.step == unbroken.step == 8
    assert same(trainer.module, unbroken.module.state_dict())
