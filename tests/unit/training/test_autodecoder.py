import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from model.networks.decoder import DecoderShape
from model.networks.flow import FlowShape
from model.networks.prior import PriorShape
from tests.ellipsoid_cohort import GRID, cohort, ellipsoid_points, ellipsoids
from training.autodecoder import AutoDecoder, Trainer, train
from training.config import ObjectiveConfig, TrainingConfig
from training.metrics_masks import dice
from training.objective import cross_entropy_loss
from training.samples import PointPool, ShapePoints

CONFIG = TrainingConfig(
    decoder=DecoderShape(latent_size=3, width=8, depth=2, extent_mm=14.0),
    prior=PriorShape(FlowShape(latent_size=3, transforms=1, bins=3, width=6)),
    steps=20,
    batch_shapes=3,
    near_points=12,
    far_points=6,
    checkpoint_every=6,
)
PAPER = ObjectiveConfig(name="paper", reconstruction="dice")


def weights(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in trainer.module.state_dict().items()}


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(value, other[name]) for name, value in one.items())


def advanced(config: TrainingConfig, steps: int) -> Trainer:
    trainer = Trainer.start(config, cohort())
    for _ in range(steps):
        trainer.advance()
    return trainer


class TestRepeatability:
    @pytest.mark.parametrize(
        "objective",
        [PAPER, ObjectiveConfig(), ObjectiveConfig(name="denoising"), ObjectiveConfig(lambda_isometry=2.0)],
    )
    def test_one_seed_gives_one_model_and_another_seed_another(self, objective):
        config = replace(CONFIG, objective=objective)
        one, again, other = (weights(advanced(replace(config, seed=seed), 6)) for seed in (0, 0, 1))
        assert same(one, again)
        assert not same(one, other)

    def test_randomness_elsewhere_in_the_process_changes_nothing(self):
        expected = weights(advanced(CONFIG, 6))
        trainer = Trainer.start(CONFIG, cohort())
        for _ in range(6):
            torch.rand(7)
            trainer.advance()
        assert same(expected, weights(trainer))

    @pytest.mark.parametrize("objective", [PAPER, ObjectiveConfig(), ObjectiveConfig(name="denoising")])
    @pytest.mark.parametrize("stop", [1, 8])
    def test_a_checkpoint_continues_bit_for_bit(self, objective, stop, tmp_path):
        config = replace(CONFIG, objective=objective)
        advanced(config, stop).save(tmp_path / "checkpoint.pt")
        resumed = Trainer.start(replace(config, seed=5), cohort())
        resumed.load(tmp_path / "checkpoint.pt")
        assert resumed.step == stop
        figures = [resumed.advance() for _ in range(stop, 14)]
        unbroken = advanced(config, 13)
        assert unbroken.advance() == figures[-1]
        assert same(weights(unbroken), weights(resumed))

    @pytest.mark.slow
    def test_a_process_killed_between_checkpoints_leaves_one_to_continue_from(self, tmp_path, repository):
        script = f"import tests.unit.training.test_autodecoder as t; t.train_and_die({str(tmp_path)!r})"
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(repository)}
        killed = subprocess.run([sys.executable, "-c", script], cwd=repository, env=environment, check=False)
        assert killed.returncode == -signal.SIGKILL
        resumed = Trainer.start(CONFIG, cohort())
        resumed.load(tmp_path / "checkpoint.pt")
        assert resumed.step == 12
        train(resumed, tmp_path)
        assert same(weights(advanced(CONFIG, CONFIG.steps)), weights(resumed))


def train_and_die(folder: str) -> None:
    """Train with checkpoints and kill this process after step 15."""

    def watch(step: int, _figures: dict[str, float]) -> None:
        if step == 15:
            os.kill(os.getpid(), signal.SIGKILL)

    train(Trainer.start(CONFIG, cohort()), Path(folder), watch)


class TestCheckpoint:
    def test_the_old_one_stays_whole_until_the_new_one_takes_its_place(self, tmp_path):
        path = tmp_path / "checkpoint.pt"
        trainer = advanced(CONFIG, 1)
        trainer.save(path)
        before = path.read_bytes()
        with path.open("rb") as reader:
            trainer.advance()
            trainer.save(path)
            assert reader.read() == before
        assert path.read_bytes() != before
        assert [found.name for found in tmp_path.iterdir()] == ["checkpoint.pt"]

    def test_a_failed_write_leaves_the_old_one(self, tmp_path):
        path = tmp_path / "checkpoint.pt"
        trainer = advanced(CONFIG, 1)
        trainer.save(path)
        before = path.read_bytes()
        (tmp_path / "checkpoint.part").mkdir()
        trainer.advance()
        with pytest.raises((OSError, RuntimeError)):
            trainer.save(path)
        assert path.read_bytes() == before

    def test_training_ends_with_a_checkpoint_of_the_last_step(self, tmp_path):
        seen = []
        train(Trainer.start(CONFIG, cohort()), tmp_path / "new" / "run", lambda step, figures: seen.append(step))
        assert seen == list(range(1, CONFIG.steps + 1))
        resumed = Trainer.start(CONFIG, cohort())
        resumed.load(tmp_path / "new" / "run" / "checkpoint.pt")
        assert resumed.step == CONFIG.steps


class TestSchedule:
    def test_the_flow_waits_and_then_learns(self):
        trainer = Trainer.start(replace(CONFIG, flow_start=0.5, warm_up=0.0), cohort())
        fresh = {name: value for name, value in weights(trainer).items() if name.startswith("prior.flow")}
        for _ in range(10):
            trainer.advance()
        assert same(fresh, weights(trainer))
        trainer.advance()
        assert not same(fresh, weights(trainer))

    def test_rates_rise_and_fall_to_zero(self):
        trainer = Trainer.start(replace(CONFIG, warm_up=0.25, flow_start=0.0), cohort())
        rates = []
        for _ in range(CONFIG.steps):
            trainer.advance()
            rates.append([group["lr"] / group["full_lr"] for group in trainer.optimiser.param_groups])
        curve = np.array(rates)
        np.testing.assert_allclose(curve, np.repeat(curve[:, :1], curve.shape[1], axis=1))
        assert curve[:, 0].argmax() == 5
        assert (np.diff(curve[:6, 0]) > 0).all()
        assert (np.diff(curve[5:, 0]) < 0).all()
        assert curve[-1, 0] < 0.01 < 0.8 < curve[5, 0]

    def test_a_cohort_smaller_than_the_batch_is_taken_whole(self):
        figures = Trainer.start(replace(CONFIG, batch_shapes=50), cohort(2)).advance()
        assert all(np.isfinite(value) for value in figures.values())


def fit(module: AutoDecoder, shape: ShapePoints) -> torch.Tensor:
    """The code that explains labelled points best."""
    code = torch.zeros(1, module.config.decoder.latent_size, requires_grad=True)
    optimiser, pool = torch.optim.Adam([code], 0.05), PointPool([shape], torch.device("cpu"))
    random = torch.Generator().manual_seed(0)
    for _ in range(80):
        batch = pool.draw(torch.tensor([0]), (192, 64), random)
        loss = cross_entropy_loss(module.decoder(code, batch.points), batch.labels, batch.weights)
        optimiser.zero_grad()
        (loss.sum() - 1e-3 * module.prior.log_density(code).sum()).backward()
        optimiser.step()
    return code.detach()


class TestLearning:
    CONFIG = TrainingConfig(
        decoder=DecoderShape(latent_size=4, width=32, depth=3, extent_mm=14.0),
        prior=PriorShape(FlowShape(latent_size=4, transforms=1, bins=3, width=8)),
        steps=400,
        batch_shapes=12,
        near_points=96,
        far_points=32,
    )

    def trained(self, config: TrainingConfig) -> tuple[AutoDecoder, list[dict[str, float]]]:
        trainer = Trainer.start(config, cohort(12))
        figures = [trainer.advance() for _ in range(config.steps)]
        return trainer.module, figures

    @pytest.mark.slow
    @pytest.mark.parametrize("objective", [ObjectiveConfig(), replace(PAPER, lambda_flow=1e-4)])
    def test_held_out_ellipsoids_are_reconstructed(self, objective):
        module, figures = self.trained(replace(self.CONFIG, objective=objective))
        losses = [step["loss"] for step in figures]
        rec = [step["reconstruction"] for step in figures]
        assert np.mean(losses[-20:]) < np.mean(losses[:20])
        assert np.mean(rec[-20:]) < 0.5 * np.mean(rec[:20])
        found = []
        for shape in ellipsoids(3, seed=99):
            code = fit(module, ellipsoid_points(shape))
            with torch.no_grad():
                logits = module.decoder(code, torch.from_numpy(GRID.centres()).float()[None])[0]
            found.append(dice(shape.mask(GRID), (logits > 0).numpy().reshape(GRID.shape)))
        assert min(found) > 0.9
        with torch.no_grad():
            mean = module.decoder(torch.zeros(1, 4), torch.from_numpy(GRID.centres()).float()[None])[0]
        blind = [dice(shape.mask(GRID), (mean > 0).numpy().reshape(GRID.shape)) for shape in ellipsoids(3, seed=99)]
        assert np.mean(found) > np.mean(blind)

    @pytest.mark.slow
    def test_isometry_makes_one_step_move_all_shapes_alike(self):
        found = {}
        for weight in (0.0, 2.0):
            objective = ObjectiveConfig(lambda_isometry=weight)
            module, figures = self.trained(replace(self.CONFIG, steps=600, objective=objective))
            assert ("unevenness" in figures[-1]) is (weight > 0.0)
            found[weight] = self.scatter(module)
        assert found[2.0] < 0.5 * found[0.0]

    def scatter(self, module: AutoDecoder) -> float:
        """Mean over steps of the code of the relative SD over shapes of how far their surfaces move (mm)."""
        points = torch.from_numpy(GRID.centres()).float()
        with torch.no_grad():
            codes = module.code_means()
            logits, by_latent, by_point = module.decoder.jacobians(codes, points.expand(len(codes), -1, -1))
            slope = by_point.norm(dim=-1)
            steps = module.prior.sigma[:, None] * torch.randn(4, 50, generator=torch.Generator().manual_seed(0))
            near = logits.abs() < 0.7 * slope
            moved = [
                (row[here] @ steps).abs() / s[here, None] for row, s, here in zip(by_latent, slope, near, strict=True)
            ]
            lengths = torch.stack([one.mean(dim=0) for one in moved])
        return float((lengths.std(dim=0) / lengths.mean(dim=0)).mean())


def test_the_weight_of_the_prior_rises_along_the_ramp():
    trainer = Trainer.start(replace(CONFIG, objective=ObjectiveConfig(ramp=0.5)), cohort())
    found = []
    for _ in range(CONFIG.steps):
        trainer.advance()
        found.append(trainer.module.pressure.item())
    assert found == pytest.approx([min(1.0, step / (0.5 * CONFIG.steps)) for step in range(CONFIG.steps)])


def test_movements_are_made_even_when_shapes_are_there_and_a_checkpoint_goes_on_alike(tmp_path):
    objective = ObjectiveConfig(lambda_isometry=1.0, isometry_start=0.5, isometry_full=0.75)
    config = replace(CONFIG, objective=objective)
    trainer, isometry_pressure, judged = Trainer.start(config, cohort()), [], []
    for step in range(CONFIG.steps):
        if step == CONFIG.steps // 2 + 2:
            trainer.save(tmp_path / "checkpoint.pt")
        judged.append("unevenness" in trainer.advance())
        isometry_pressure.append(trainer.module.isometry_pressure.item())
    np.testing.assert_allclose(isometry_pressure[9:16], [0.0, 0.0, 0.2, 0.4, 0.6, 0.8, 1.0], atol=1e-6)
    assert judged == [False] * 10 + [True] * 10
    resumed = Trainer.start(config, cohort())
    resumed.load(tmp_path / "checkpoint.pt")
    while not resumed.at_end():
        resumed.advance()
    assert same(weights(trainer), weights(resumed))
