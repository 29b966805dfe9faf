"""Whether uncertainty can be believed: on test shapes, against what was set out to be reached.

Every cell (an answer, a run of planes, a strange shape) is written as soon as it is measured; a run that was ended goes
on where it stopped. At the end: ``table.md`` and a diagram a cohort.
"""

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.accuracy.command import bundles_of
from benchmarks.accuracy.drawings import DrawingName
from benchmarks.accuracy.plan import chosen_cases
from benchmarks.uncertainty.answers import measure_answer
from benchmarks.uncertainty.cells import Key, Payload, Store
from benchmarks.uncertainty.diagrams import save_diagrams
from benchmarks.uncertainty.maps import save_maps
from benchmarks.uncertainty.next_planes import RUNS, measure_next_planes
from benchmarks.uncertainty.strangers import Trial, measure_trial, trials
from benchmarks.uncertainty.summary import Line, lines_of
from model.bundle import ShapeModel, open_bundle, read_manifest
from training.choices import RegimeName
from training.cohort_options import DataOption
from training.cohorts import Case, CohortName, CohortOptions, data_folder, load_cohort
from training.console import exit_status, progress
from training.sparsify import REGIMES

OUTPUT = Path("results/uncertainty")
#: Cohorts whose shapes are sent to another cohort's model, and how many of each.
STRANGERS, STRANGE_CASES = (CohortName.FEMUR, CohortName.TALUS), 10
#: Regimes in which answers are measured.
MEASURED = [RegimeName.ORTHOGONAL, RegimeName.THIN]


@dataclass(frozen=True)
class Task:
    """One cell to be measured: a case for an answer or a run of planes, a trial for a strange shape."""

    key: Key
    bundle: Path
    subject: Case | Trial
    run: int = 0


def main(
    cohort: Annotated[list[CohortName] | None, typer.Option(help="May repeat; those with a model.")] = None,
    model: Annotated[list[str] | None, typer.Option(help="COHORT=BUNDLE; may repeat, shipped ones are there.")] = None,
    regimes: Annotated[list[RegimeName] | None, typer.Option(help="May repeat; orthogonal and thin.")] = None,
    cases: Annotated[int, typer.Option(min=1, help="Test cases of a cohort at most, evenly spaced.")] = 30,
    plane_cases: Annotated[int, typer.Option(min=0, help="Cases on which planes are advised.")] = 10,
    gold_cases: Annotated[int, typer.Option(min=0, help="Cases that are sampled, minutes each.")] = 0,
    strangers: Annotated[CohortName | None, typer.Option(help="Whose model is sent strange shapes.")] = None,
    data: DataOption = None,
    output: Annotated[Path, typer.Option(help="Folder of cells, table and diagrams.")] = OUTPUT,
    jobs: Annotated[int, typer.Option(min=1, help="Processes at a time.")] = 1,
    mapped: Annotated[int, typer.Option(min=0, help="Cases whose SDs are drawn beside the errors.")] = 0,
) -> None:
    """Measure intervals, voxels, vertices, time, advice and typicality."""
    with exit_status():
        bundles = bundles_of(model or [])
        chosen = cohort or [name for name in CohortName if name in bundles]
        tasks: list[Task] = []
        shown: dict[str, tuple[Case, ...]] = {}
        for name in chosen:
            found = load_cohort(name, data_folder(data), CohortOptions(skip_refused=True))
            mine = chosen_cases(found.test, cases)
            shown[name.value] = chosen_cases(mine, mapped) if mapped else ()
            tasks += _tasks(name.value, bundles[name], mine, regimes or MEASURED, plane_cases)
            tasks += _gold_tasks(name.value, bundles[name], mine, regimes or MEASURED, gold_cases)
            if strangers is name:
                tasks += _strange_tasks(name, bundles[name], mine, data, regimes or MEASURED)
        store = Store(output / "cells.jsonl")
        faults = _measure(tasks, store, jobs)
        there = store.read()
        cells = {task.key: there[task.key] for task in tasks if task.key in there}
        text = as_markdown(lines_of(cells))
        output.mkdir(parents=True, exist_ok=True)
        (output / "table.md").write_text(text + "\n", encoding="utf-8")
        for name in chosen:
            save_diagrams(cells, name.value, output / f"uncertainty-{name.value}.png")
            for regime in (regimes or MEASURED) if shown[name.value] else ():
                path = output / f"maps-{name.value}-{regime}.png"
                save_maps(_opened(bundles[name]), shown[name.value], DrawingName(regime.value), path)
        typer.echo(text)
        for fault in faults:
            typer.echo(f"not measured: {fault}", err=True)
        if faults:
            raise typer.Exit(1)


def _tasks(
    cohort: str, bundle: Path, cases: Sequence[Case], regimes: Sequence[RegimeName], plane_cases: int
) -> Iterator[Task]:
    digest = read_manifest(bundle)[1]
    for case in cases:
        for regime in regimes:
            yield Task(Key("answer", cohort, case.name, regime.value, digest), bundle, case)
    for case in chosen_cases(cases, plane_cases) if plane_cases else ():
        for run in range(RUNS):
            for strategy in ("advised", "random"):
                yield Task(Key("next-plane", cohort, f"{case.name}:{run}", strategy, digest), bundle, case, run)


def _gold_tasks(
    cohort: str, bundle: Path, cases: Sequence[Case], regimes: Sequence[RegimeName], count: int
) -> Iterator[Task]:
    digest = read_manifest(bundle)[1]
    for case in chosen_cases(cases, count) if count else ():
        for regime in regimes:
            yield Task(Key("gold", cohort, case.name, regime.value, digest), bundle, case)


def _strange_tasks(
    cohort: CohortName, bundle: Path, own: Sequence[Case], data: Path | None, regimes: Sequence[RegimeName]
) -> Iterator[Task]:
    digest = read_manifest(bundle)[1]
    options = CohortOptions(skip_refused=True)
    others = {
        name.value: chosen_cases(load_cohort(name, data_folder(data), options).cases, STRANGE_CASES)
        for name in STRANGERS
        if name is not cohort
    }
    for trial in trials(own, others):
        for regime in regimes:
            key = Key("stranger", cohort.value, f"{trial.kind}:{trial.name}", regime.value, digest)
            yield Task(key, bundle, trial)


def _measure(tasks: Sequence[Task], store: Store, jobs: int) -> list[str]:
    known = store.read()
    left = [task for task in tasks if task.key not in known]
    faults: list[str] = []
    context = multiprocessing.get_context("spawn")
    with progress(len(left), "measuring") as bar, ProcessPoolExecutor(jobs, mp_context=context) as pool:
        running = {pool.submit(_measured, task): task for task in left}
        for future in as_completed(running):
            key = running[future].key
            if future.exception() is not None:
                faults.append(f"{key.cohort} {key.kind} {key.subject} {key.regime}: {future.exception()!r}")
            else:
                store.append(key, future.result())
            bar.update(bar.task_ids[0], advance=1, description=f"{key.cohort} {key.kind}")
    return faults


@lru_cache(maxsize=2)
def _opened(bundle: Path) -> ShapeModel:
    return open_bundle(bundle, threads=1)


def _measured(task: Task) -> Payload:
    """In a process of its own."""
    model, subject = _opened(task.bundle), task.subject
    if task.key.kind == "next-plane" and isinstance(subject, Case):
        return measure_next_planes(model, subject, advised=task.key.regime == "advised", run=task.run)
    (regime,) = [name for name in REGIMES if name == task.key.regime]
    if isinstance(subject, Trial):
        return measure_trial(model, subject, regime)
    if task.key.kind == "gold":
        from benchmarks.uncertainty.gold import measure_gold  # needs Pyro

        return measure_gold(model, subject, regime)
    return measure_answer(model, subject, regime)


def as_markdown(lines: Sequence[Line]) -> str:
    """A table a scope."""
    parts = []
    for scope in dict.fromkeys(line.scope for line in lines):
        rows = ["| | found | to reach | |", "| --- | --- | --- | --- |"]
        for line in (line for line in lines if line.scope == scope):
            verdict = {None: "", True: "reached", False: "**not reached**"}[line.reached]
            rows.append(f"| {line.words} | {line.found:.{line.digits}f} | {_bounds(line)} | {verdict} |")
        parts.append(f"### {scope}\n\n" + "\n".join(rows))
    return "\n\n".join(parts)


def _bounds(line: Line) -> str:
    if line.low is None:
        return "" if line.high is None else f"at most {line.high:g}"
    return f"at least {line.low:g}" if line.high is None else f"{line.low:g} to {line.high:g}"
