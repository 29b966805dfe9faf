"""Speed of training: time of a step, rate of its matrix products, and the share of the machine's own rate.

Shapes are balls of points made here, as many and as dense as the hippocampus cohort's, so that no cohort is needed. The
multiplications and additions of the matrix products of a step are counted by torch's own counter. The rate of
a plain single-precision product is measured at a large size and at the size that the decoder uses, in
between. The best of the repeats counts: what else runs on the machine only adds time.

    OMP_NUM_THREADS=2 python -m benchmarks.training
    python -m benchmarks.training --device cuda
"""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
import torch
import typer
from torch.utils.flop_counter import FlopCounterMode

from training.autodecoder import READ_EVERY, Trainer
from training.choices import DeviceName, ObjectiveName, RegimeName, TrainingChoice, configured, with_batches
from training.samples import ShapePoints

LARGE = 2048
POINTS_A_SHAPE = 20_000


@dataclass(frozen=True)
class Speed:
    """What was measured.

    Attributes:
        step_ms: best time of a step, figures read as often as in a run.
        gflop: of the matrix products of a step, forward and backward.
        rate, large_rate, same_rate: GFLOP/s of the step, of a large product, of one of the decoder's size.
        minutes: of a run of the default length.
    """

    device: str
    threads: int
    step_ms: float
    gflop: float
    rate: float
    large_rate: float
    same_rate: float
    minutes: float


def main(
    latent_size: Annotated[int, typer.Option(min=1, help="Dimensions of the latent code.")] = 64,
    shapes: Annotated[int, typer.Option(min=2, help="Training shapes.")] = 144,
    repeats: Annotated[int, typer.Option(min=1, help="Rounds of steps; the best counts.")] = 5,
    steps: Annotated[int, typer.Option(min=1, help="Steps of a round.")] = 10,
    device: Annotated[DeviceName, typer.Option(help="Where to compute.")] = DeviceName.AUTO,
    together: Annotated[bool, typer.Option("--together", help="Train flow and ARD along.")] = False,
    profile: Annotated[bool, typer.Option("--profile", help="Print where the time of a step goes.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Write the result as JSON.")] = False,
) -> None:
    """Measure training on this machine."""
    trainer = _trainer(latent_size, shapes, device, together=together)
    speed = measured(trainer, repeats, steps)
    if profile:
        typer.echo(profiled(trainer, steps))
    if as_json:
        typer.echo(json.dumps(asdict(speed)))
        return
    typer.echo(words_of(speed, trainer.config.steps))


def words_of(speed: Speed, steps: int) -> str:
    """What was measured, in three lines."""
    large, same = (100 * speed.rate / rate for rate in (speed.large_rate, speed.same_rate))
    return (
        f"{speed.step_ms:.1f} ms a step on {speed.device}, {speed.threads} thread(s): {speed.gflop:.2f} GFLOP, "
        f"{speed.rate:.0f} GFLOP/s\n"
        f"{large:.0f} % of a product of {LARGE} x {LARGE} ({speed.large_rate:.0f} GFLOP/s), "
        f"{same:.0f} % of one of the decoder's size ({speed.same_rate:.0f} GFLOP/s)\n"
        f"{speed.minutes:.1f} minutes for {steps} steps"
    )


def measured(trainer: Trainer, repeats: int, steps: int) -> Speed:
    """Steps and products in turn."""
    config = trainer.config
    points = config.batch_shapes * (config.near_points + config.far_points)
    device = trainer.pool.device
    with FlopCounterMode(display=False) as counter:
        trainer.advance()
    gflop = counter.get_total_flops() / 1e9
    best, large, same = np.inf, 0.0, 0.0
    for _ in range(repeats):
        best = min(best, _seconds(lambda: _advance(trainer, steps), device) / steps)
        large = max(large, _product_rate(LARGE, LARGE, LARGE, device))
        same = max(same, _product_rate(points, config.decoder.width, config.decoder.width, device))
    return Speed(
        str(device), torch.get_num_threads(), 1e3 * best, gflop, gflop / best, large, same, best * config.steps / 60.0
    )


def profiled(trainer: Trainer, steps: int) -> str:
    """Table of the operations that take most of the time."""
    activities = [torch.profiler.ProfilerActivity.CPU]
    if trainer.pool.device.type == "cuda":
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    with torch.profiler.profile(activities=activities) as found:
        _advance(trainer, steps)
    averages: Any = found.key_averages()
    return str(averages.table(sort_by="self_cpu_time_total", row_limit=20, max_name_column_width=50))


def _trainer(latent_size: int, shapes: int, device: DeviceName, *, together: bool) -> Trainer:
    choice = TrainingChoice(
        ObjectiveName.VARIATIONAL, RegimeName.DENSE, latent_size, flow=together, ard=together, device=device
    )
    config = configured(choice, reflected=False)
    trainer = Trainer.start(with_batches(config, shapes), [_ball(number) for number in range(shapes)])
    trainer.step = int(config.flow_start * config.steps) + 1
    return trainer


def _ball(number: int) -> ShapePoints:
    rng = np.random.default_rng(number)
    points = rng.uniform(-30.0, 30.0, (POINTS_A_SHAPE, 3)).astype(np.float32)
    radius = np.linalg.norm(points, axis=1)
    size = 12.0 + 6.0 * rng.random()
    return ShapePoints(points, radius < size, np.abs(radius - size) < 3.0)


def _advance(trainer: Trainer, steps: int) -> None:
    for number in range(steps):
        trainer.advance(read=(number + 1) % READ_EVERY == 0)


def _product_rate(rows: int, inner: int, columns: int, device: torch.device) -> float:
    one, other = torch.randn(rows, inner, device=device), torch.randn(inner, columns, device=device)
    calls = max(1, int(2e9 / (rows * inner * columns)))

    def products() -> None:
        for _ in range(calls):
            _ = one @ other

    products()
    return calls * 2 * rows * inner * columns / _seconds(products, device) / 1e9


def _seconds(work: Callable[[], None], device: torch.device) -> float:
    _wait(device)
    begin = time.perf_counter()
    work()
    _wait(device)
    return time.perf_counter() - begin


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


if __name__ == "__main__":
    typer.run(main)
