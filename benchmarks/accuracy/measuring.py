"""Measuring cells in processes of their own, one method on one cohort each, so that memory is the method's own."""

import math
import multiprocessing
import os
import queue
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass

from benchmarks.accuracy.cells import Cell, CellKey
from benchmarks.accuracy.drawings import draw
from benchmarks.accuracy.memory import with_peak
from benchmarks.accuracy.methods import Fill, Sources, make_fill
from benchmarks.accuracy.names import MethodName
from model.errors import InputError
from training.cohorts.cohort import Case
from training.metrics_masks import agreement

#: Seconds between looks at whether a process has ended.
LOOK_S = 0.5


@dataclass(frozen=True)
class Task:
    """Cells of one method on one cohort; ``cases`` holds each case that a key names."""

    method: MethodName
    sources: Sources
    keys: tuple[CellKey, ...]
    cases: dict[str, Case]


def measure_all(tasks: Sequence[Task], jobs: int, watch: Callable[[Cell], None]) -> list[str]:
    """Measure the tasks, so many at a time; returns a sentence for each task that ended in a fault.

    Args:
        watch: is given each cell as soon as it is measured, in this process.
    """
    _limit_threads(max((task.sources.threads for task in tasks), default=1))
    context = multiprocessing.get_context("spawn")
    with context.Manager() as manager:
        cells: queue.Queue[Cell] = manager.Queue()
        with ProcessPoolExecutor(jobs, context, max_tasks_per_child=1) as pool:
            running = {pool.submit(_run, task, cells): task for task in tasks}
            for cell in _arriving(list(running), cells):
                watch(cell)
            return [_fault(task, future) for future, task in running.items() if future.exception()]


def measure(key: CellKey, case: Case, fill: Fill) -> Cell:
    """One cell; a drawing that the method cannot take is an answer."""
    drawing = draw(case, key.drawing)
    begin, cpu = time.perf_counter(), time.process_time()
    try:
        found, peak = with_peak(lambda: fill(drawing, case.grid))
    except InputError as error:
        nan = math.nan
        return Cell(key, nan, nan, nan, nan, nan, time.perf_counter() - begin, nan, nan, str(error))
    seconds, cpu_s = time.perf_counter() - begin, time.process_time() - cpu
    figures = agreement(case.mask, found.mask, case.grid.spacing)
    fit_s = seconds if found.fit_s is None else found.fit_s
    return Cell(
        key, figures.dice, figures.asd_mm, figures.hd95_mm, figures.hd_mm, fit_s, seconds, cpu_s, peak, refusal=""
    )


def _run(task: Task, cells: "queue.Queue[Cell]") -> None:
    """In its own process: load, warm up, measure."""
    fill = make_fill(task.method, task.sources)
    if task.method is not MethodName.ADAM:
        measure(task.keys[0], task.cases[task.keys[0].case], fill)
    for key in task.keys:
        cells.put(measure(key, task.cases[key.case], fill))


def _arriving(running: Sequence[Future[None]], cells: "queue.Queue[Cell]") -> Iterator[Cell]:
    while True:
        ended = all(future.done() for future in running)
        try:
            yield cells.get(timeout=LOOK_S)
        except queue.Empty:
            if ended:
                return


def _fault(task: Task, future: Future[None]) -> str:
    return f"{task.keys[0].cohort}, {task.method}: {future.exception()!r}"


def _limit_threads(count: int) -> None:
    """Processes that are started from here on use so many threads in their linear algebra."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(count)
