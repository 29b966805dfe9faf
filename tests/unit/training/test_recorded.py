"""A recorded step has the effect of the step; where a CUDA device is there."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from model.networks.decoder import DecoderShape
from model.networks.flow import FlowShape
from model.networks.prior import PriorShape
from training.autodecoder import Trainer
from training.config import TrainingConfig
from training.recorded import WARM_UP
from training.samples import ShapePoints

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")

CONFIG = TrainingConfig(
    decoder=DecoderShape(latent_size=4, width=32, depth=3, extent_mm=30.0),
    prior=PriorShape(FlowShape(latent_size=4)),
    device="cuda",
    steps=40,
    batch_shapes=4,
    flow_start=0.2,
)


def balls(count: int) -> list[ShapePoints]:
    rng = np.random.default_rng(0)
    found = []
    for number in range(count):
        points = rng.uniform(-25.0, 25.0, (4000, 3)).astype(np.float32)
        gap = np.linalg.norm(points, axis=1) - (10.0 + number)
        found.append(ShapePoints(points, gap < 0, np.abs(gap) < 3.0))
    return found


def weights(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {name: value.cpu() for name, value in trainer.module.state_dict().items()}


def test_replays_change_the_parameters_as_the_step_itself_does():
    recorded, plain = (Trainer.start(CONFIG, balls(8)) for _ in range(2))
    plain._advance_module = plain.update
    for _ in range(CONFIG.steps):
        one, other = recorded.advance(), plain.advance()
        assert one == pytest.approx(other, rel=1e-3, abs=1e-4)
    for name, value in weights(plain).items():
        torch.testing.assert_close(weights(recorded)[name], value, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("stop", [1, WARM_UP + 5])
def test_a_checkpoint_continues_through_the_recording(stop, tmp_path):
    unbroken = Trainer.start(CONFIG, balls(8))
    for _ in range(stop):
        unbroken.advance()
    unbroken.save(tmp_path / "checkpoint.pt")
    resumed = Trainer.start(replace(CONFIG, seed=5), balls(8))
    resumed.advance()
    resumed.load(tmp_path / "checkpoint.pt")
    for _ in range(12):
        assert resumed.advance() == pytest.approx(unbroken.advance(), rel=1e-3, abs=1e-4)
