"""Processes that share a sweep's folder: each takes the next training that nobody holds, with its cells.

A training is held by a lock on a file in its folder, which the system lets go when a process dies, so that a killed
sweep leaves nothing to clean. On the CPU each process computes with one thread. Trainings on a GPU come first, side by
side in one process (`training.sweep.streams`); `torchrun` starts one for each GPU, and these need no other word between
them than the folder.
"""

import fcntl
import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.process import BaseProcess
from pathlib import Path

from model.errors import MorphoFlowError
from training.choices import DeviceName
from training.cohorts.assemble import CohortOptions
from training.cohorts.cohort import Cohort
from training.cohorts.sources import CohortSource, open_cohort
from training.sweep.cell import CELLS, TRAININGS, Effort, Place, Watch, run_cell
from training.sweep.plan import Cell, by_training
from training.sweep.table import append, done

REFUSED = "refused.txt"
#: Seconds between two looks at what other processes hold.
WAIT_S = 0.5


@dataclass(frozen=True)
class Sweep:
    """What all workers are told.

    Attributes:
        cells: in the order in which they are taken.
        folder: of the table and of the cells.
    """

    source: CohortSource
    options: CohortOptions
    cells: tuple[Cell, ...]
    folder: Path
    effort: Effort
    device: DeviceName


def start_workers(sweep: Sweep, jobs: int) -> list[BaseProcess]:
    """Start processes of one thread; they end when no cell is left."""
    context = multiprocessing.get_context("spawn")
    workers: list[BaseProcess] = [
        context.Process(target=work_for, args=(sweep, os.getpid()), daemon=True) for _ in range(jobs)
    ]
    with _environment(OMP_NUM_THREADS="1", MKL_NUM_THREADS="1"):
        for worker in workers:
            worker.start()
    return workers


@contextmanager
def _environment(**variables: str) -> Iterator[None]:
    """Variables of the processes that are started inside: what they compute with reads them when it is loaded."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def work_for(sweep: Sweep, parent: int) -> None:
    """Work as long as the process that asked for it lives: when that one is killed, no orphan goes on."""

    def watch(words: str, done: int, total: int) -> None:
        if os.getppid() != parent:
            raise SystemExit(f"the sweep's process ended while {words} stood at {done} of {total}")

    work(sweep, watch)


def work(sweep: Sweep, watch: Watch = lambda words, done, total: None) -> None:
    """Take trainings until none is left whose cells are neither done nor held by another process."""
    import torch

    torch.set_num_threads(1)
    cohorts = Cohorts(sweep)
    for key, cells in by_training(sweep.cells).items():
        with held(sweep.folder / TRAININGS / key) as mine:
            for cell in cells:
                if mine and cell.key not in done(sweep.folder):
                    _attempt(sweep, cell, cohorts, watch)


def work_together(sweep: Sweep, watch: Watch = lambda words, done, total: None) -> None:
    """The same until every cell has a result or a refusal, made here or elsewhere; what others leave is taken over."""
    work(sweep, watch)
    while left := [cell for cell in unfinished(sweep) if not _refusal(sweep, cell).is_file()]:
        time.sleep(WAIT_S)
        work(replace(sweep, cells=tuple(left)), watch)


class Cohorts:
    """The cohort of each seed, opened when it is first asked for."""

    def __init__(self, sweep: "Sweep") -> None:
        self._sweep = sweep
        self._open: dict[int, Cohort] = {}

    def of(self, cell: Cell) -> Cohort:
        """The cohort that a cell is trained on."""
        if cell.seed not in self._open:
            self._open[cell.seed] = open_cohort(self._sweep.source, replace(self._sweep.options, seed=cell.seed))
        return self._open[cell.seed]


@contextmanager
def held(folder: Path) -> Iterator[bool]:
    """Whether this process holds the folder while the block runs."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True


def refusals(sweep: Sweep) -> dict[str, str]:
    """Cells that could not be brought to a result, and why."""
    paths = {cell.key: _refusal(sweep, cell) for cell in sweep.cells}
    return {key: path.read_text(encoding="utf-8") for key, path in paths.items() if path.is_file()}


def _refusal(sweep: Sweep, cell: Cell) -> Path:
    return sweep.folder / CELLS / cell.key / REFUSED


def _attempt(sweep: Sweep, cell: Cell, cohorts: Cohorts, watch: Watch) -> None:
    refused = _refusal(sweep, cell)
    refused.parent.mkdir(parents=True, exist_ok=True)
    refused.unlink(missing_ok=True)
    try:
        place = Place.of(sweep.folder, cell)
        result = run_cell(cell, cohorts.of(cell), place, sweep.effort, sweep.device, watch=watch)
        append(sweep.folder, result)
    except MorphoFlowError as error:
        refused.write_text(str(error), encoding="utf-8")


def unfinished(sweep: Sweep) -> Sequence[Cell]:
    """Cells without a result."""
    there = done(sweep.folder)
    return [cell for cell in sweep.cells if cell.key not in there]
