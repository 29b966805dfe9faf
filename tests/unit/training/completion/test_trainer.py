"""A small completion network learns ellipsoids, and goes on where it was left."""

import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from model.errors import InvalidParameter
from model.geometry import Grid
from tests.analytic_shapes import Ellipsoid
from training.cohorts.cohort import Case
from training.completion.samples import random_sample, windows_of
from training.completion.trainer import CHECKPOINT, SAVED_EVERY, CompletionConfig, completion_loss, train_completion
from training.interruption import Stopped

GRID = Grid((30, 30, 30), np.diag([1.0, 1.0, 1.0, 1.0]))
MIDDLE = np.full(3, 14.5)
WINDOWS = windows_of(
    [
        Case(f"{n}", f"{n}", "train", Ellipsoid((7.0 + 0.3 * n, 8.0, 9.0 - 0.2 * n), MIDDLE).mask(GRID), GRID)
        for n in range(6)
    ]
)
CONFIG = CompletionConfig((16, 16, 16), 1.6, width=8, steps=100, batch=2)


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def dice(net, seed):
    sample = random_sample(WINDOWS[seed % 6], CONFIG.lattice, np.random.default_rng([99, seed]))
    with torch.no_grad():
        found = net(torch.from_numpy(sample.drawn[None]).float())[0].numpy() > 0
    truth = sample.inside > 0.5
    return 2.0 * np.sum(found & truth) / (found.sum() + truth.sum())


def test_it_learns_to_fill_in(tmp_path):
    losses = []
    net = train_completion(WINDOWS, CONFIG, tmp_path, half=False, watch=lambda step, loss: losses.append(loss))
    assert len(losses) == 100
    assert np.mean(losses[-10:]) < 0.5 * np.mean(losses[:10])
    assert np.mean([dice(net, seed) for seed in range(6)]) > 0.75


def test_a_training_that_was_ended_goes_on_to_the_same_network(tmp_path):
    class Ended(Exception):
        pass

    config = replace(CONFIG, steps=SAVED_EVERY + 10, width=4, batch=1, reflected=True)

    def end(step, _):
        if step == SAVED_EVERY + 5:
            raise Ended

    whole = train_completion(WINDOWS, config, tmp_path / "whole", half=False)
    with pytest.raises(Ended):
        train_completion(WINDOWS, config, tmp_path / "parts", half=False, watch=end)
    steps = []
    resumed = train_completion(
        WINDOWS, config, tmp_path / "parts", half=False, watch=lambda step, loss: steps.append(step)
    )
    assert steps == list(range(SAVED_EVERY + 1, SAVED_EVERY + 11))
    for name, value in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], value, rtol=0.0, atol=0.0)


@pytest.mark.usefixtures("keyboard")
def test_an_interrupt_from_the_keyboard_loses_no_step(tmp_path):
    config = replace(CONFIG, steps=3, width=4, batch=1)

    def interrupt(step, _):
        if step == 2:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Stopped, match="stopped at step 2 of 3"):
        train_completion(WINDOWS, config, tmp_path, half=False, watch=interrupt)
    steps = []
    train_completion(WINDOWS, config, tmp_path, half=False, watch=lambda step, loss: steps.append(step))
    assert steps == [3]


@pytest.mark.parametrize("other", [{"config": replace(CONFIG, steps=3, width=4, batch=1)}, {"masks": ("b",)}])
def test_a_checkpoint_of_other_settings_or_masks_is_refused_and_stays(tmp_path, other):
    made_of = {"config": replace(CONFIG, steps=2, width=4, batch=1), "masks": ("a",)}

    def trained(config, masks):
        train_completion(WINDOWS, config, tmp_path, masks=masks, half=False)

    trained(**made_of)
    before = (tmp_path / CHECKPOINT).read_bytes()
    with pytest.raises(InvalidParameter, match="other masks or settings"):
        trained(**{**made_of, **other})
    assert (tmp_path / CHECKPOINT).read_bytes() == before


def test_a_damaged_checkpoint_is_told_of(tmp_path):
    config = replace(CONFIG, steps=2, width=4, batch=1)
    train_completion(WINDOWS, config, tmp_path, half=False)
    content = (tmp_path / CHECKPOINT).read_bytes()
    (tmp_path / CHECKPOINT).write_bytes(content[: len(content) // 2])
    with pytest.raises(InvalidParameter, match=f"cannot be read, since {CHECKPOINT}"):
        train_completion(WINDOWS, config, tmp_path, half=False)


class TestLoss:
    INSIDE = torch.zeros(1, 4, 4, 4)
    INSIDE[:, 1:3, 1:3, 1:3] = 1.0
    KNOWN = torch.ones(1, 4, 4, 4)

    def test_it_is_zero_for_the_truth_and_grows_with_the_error(self):
        sure = 40.0 * (self.INSIDE - 0.5)
        right, wrong = (completion_loss(sign * sure, self.INSIDE, self.KNOWN) for sign in (1.0, -1.0))
        assert right == pytest.approx(0.0, abs=1e-5)
        assert wrong > 100.0

    def test_unknown_voxels_do_not_count(self):
        known = self.KNOWN.clone()
        known[:, 3] = 0.0
        logits = torch.randn(1, 4, 4, 4)
        other = logits.clone()
        other[:, 3] = 17.0
        assert completion_loss(logits, self.INSIDE, known) == completion_loss(other, self.INSIDE, known)
