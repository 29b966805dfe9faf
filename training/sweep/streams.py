"""The trainings of a sweep side by side on one GPU, each in a stream of this process.

A step of a network this small leaves most of a GPU idle. Kernels of several streams of one process run at the same
time, those of several processes take turns.
"""

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass, replace

import torch

from model.errors import MorphoFlowError
from training.autodecoder import Watch
from training.runs import Run, is_finished
from training.sweep.cell import TRAININGS, Place, config_of, prepared
from training.sweep.plan import Cell, by_training
from training.sweep.workers import Cohorts, Sweep, held

#: Trainings at a time. More gain little, and each holds its points on the GPU.
STREAMS = 8


@dataclass(frozen=True)
class Progress:
    """How far all trainings are: those begun and ended, the steps that were made and those of all begun ones."""

    begun: int = 0
    ended: int = 0
    steps: int = 0
    all_steps: int = 0


def train_side_by_side(sweep: Sweep, watch: Callable[[Progress], None] = lambda found: None) -> None:
    """Bring every training to its end that is not there yet and that no other process holds.

    The points of the next one are made while those before it train.
    """
    if "LOCAL_RANK" in os.environ and torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]) % torch.cuda.device_count())
    cohorts, slots, told = Cohorts(sweep), threading.BoundedSemaphore(STREAMS), _Told(watch)
    with ThreadPoolExecutor(STREAMS) as pool, ExitStack() as holding:
        begun: list[Future[None]] = []
        for key, cells in by_training(sweep.cells).items():
            run = _next_run(sweep, key, cells[0], cohorts, holding)
            if run is not None:
                slots.acquire()
                begun.append(pool.submit(_train, run, own_stream(run.trainer.pool.device), told))
                begun[-1].add_done_callback(lambda _: slots.release())
        for future in begun:
            future.result()


def _next_run(sweep: Sweep, key: str, cell: Cell, cohorts: Cohorts, holding: ExitStack) -> Run | None:
    """The training of a cell, held by this process until all end; None where nothing is left to do.

    One that is refused is left to the worker that comes to it, which records why.
    """
    place = Place.of(sweep.folder, cell)
    if not holding.enter_context(held(sweep.folder / TRAININGS / key)) or place.is_exported:
        return None
    cohort = cohorts.of(cell)
    config = config_of(cell, cohort, sweep.effort, sweep.device)
    try:
        return None if is_finished(place.run, cohort, config) else prepared(cohort, config, place.run)
    except MorphoFlowError:
        return None


def own_stream(device: torch.device) -> AbstractContextManager[object]:
    """What runs inside goes to a stream of its own on the present GPU, behind what was begun so far; as it is on a CPU.

    For another thread to enter: streams and devices are chosen for each thread.
    """
    if device.type != "cuda":
        return nullcontext()
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    return torch.cuda.stream(stream)


def _train(run: Run, stream: AbstractContextManager[object], told: "_Told") -> None:
    told.begins(run)
    with stream:
        run.go(told.watch(run))
    told.ends()


class _Told:
    """Adds up what the trainings tell, from several threads."""

    def __init__(self, watch: Callable[[Progress], None]) -> None:
        self._watch = watch
        self._lock = threading.Lock()
        self._progress = Progress()

    def begins(self, run: Run) -> None:
        self._add(begun=1, all_steps=run.trainer.config.steps - run.trainer.step)

    def watch(self, run: Run) -> Watch:
        """For one run; tells now and then, when there are figures."""
        told = run.trainer.step

        def step(number: int, figures: dict[str, float]) -> None:
            nonlocal told
            if figures:
                self._add(steps=number - told)
                told = number

        return step

    def ends(self) -> None:
        self._add(ended=1)

    def _add(self, **more: int) -> None:
        with self._lock:
            self._progress = replace(
                self._progress, **{name: getattr(self._progress, name) + value for name, value in more.items()}
            )
            self._watch(self._progress)
