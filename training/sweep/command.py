"""The command sweep."""

import json
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from training.choices import DeviceName, ObjectiveName, RegimeName, resolved
from training.cohort_options import opened_cohort, takes_cohort
from training.cohorts import CohortOptions
from training.cohorts.sources import CohortSource
from training.console import BAD_INPUT_STATUS, FAULT_STATUS, JsonOption, exit_status, progress, tell_findings, warn
from training.sweep.priors import PriorName

if TYPE_CHECKING:
    from training.sweep.workers import Sweep

LATENT_SIZES = [16, 32, 64, 128, 256]
REGIMES = [RegimeName.THIN, RegimeName.THICK, RegimeName.ORTHOGONAL]
PRIORS = [PriorName.PLAIN, PriorName.FLOW_ARD]
#: Validations without a better figure after which a training ends.
PATIENCE = 5
#: Seconds between two looks at the workers.
LOOK_S = 0.5


@takes_cohort
def sweep(
    source: CohortSource,
    options: CohortOptions,
    output: Annotated[Path, typer.Option(help="Folder of the table and the cells; a sweep in it goes on.")],
    latent_size: Annotated[list[int] | None, typer.Option(min=1, max=1024, help="May repeat; 16 to 256.")] = None,
    regime: Annotated[list[RegimeName] | None, typer.Option(help="May repeat; thin, thick and orthogonal.")] = None,
    prior: Annotated[list[PriorName] | None, typer.Option(help="May repeat; plain and flow-ard.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Seeds from --seed on.")] = 1,
    objective: Annotated[ObjectiveName, typer.Option(help="What is minimised.")] = ObjectiveName.VARIATIONAL,
    steps: Annotated[int | None, typer.Option(min=1, help="Optimiser steps of each cell.")] = None,
    patience: Annotated[
        int | None,
        typer.Option(
            min=0,
            help=f"End after so many validations without a better figure, {PATIENCE} when left out; 0 never does.",
        ),
    ] = None,
    calibrate: Annotated[bool, typer.Option("--calibrate/--no-calibrate", help="Calibrate each training.")] = True,
    samples: Annotated[int, typer.Option(min=0, help="Generated shapes of each cell.")] = 1500,
    limit: Annotated[int | None, typer.Option(min=1, help="Measure only so many cases.")] = None,
    bundle: Annotated[
        list[Path] | None, typer.Option(help="An exported model as a cell of its own; may repeat.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes; one a CPU core when left out.")] = None,
    device: Annotated[DeviceName, typer.Option(help="Where to compute.")] = DeviceName.AUTO,
    as_json: JsonOption = False,
) -> None:
    """Train and measure many models side by side, cell by cell; what is there is skipped."""
    with exit_status():
        from training.configuring import check_patience
        from training.sweep.cell import Effort, Place, adopt, by_cell, check_test
        from training.sweep.plan import cells_of
        from training.sweep.record import write_record
        from training.sweep.workers import Sweep

        given = by_cell(bundle or ())
        found = opened_cohort(source, options)
        tell_findings(found)
        check_test(found)
        check_patience(found, patience)
        effort = Effort(steps, PATIENCE if patience is None else patience, calibrate, samples, limit)
        if not write_record(output, source, options, effort.settings()):
            warn("the sweep in the output folder is of an earlier version, whose settings are not known")
        for cell, path in given.items():
            adopt(path, Place.of(output, cell))
        asked = cells_of(
            latent_size or LATENT_SIZES,
            [one.value for one in regime or REGIMES],
            prior or PRIORS,
            range(options.seed, options.seed + seeds),
            objective.value,
        )
        only_given = given and not (latent_size or regime or prior)
        cells = tuple(given if only_given else dict.fromkeys([*given, *asked]))
        _run(Sweep(source, options, cells, output, effort, device), jobs, as_json=as_json)


def _run(plan: "Sweep", jobs: int | None, *, as_json: bool) -> None:
    from training.sweep.summary import CSV, write_csv
    from training.sweep.table import TABLE, read_results
    from training.sweep.workers import refusals, unfinished, work, work_together

    plan.folder.mkdir(parents=True, exist_ok=True)
    if resolved(plan.device) == "cuda":
        _train_side_by_side(plan)
    # torchrun ends all of its processes when one of them ends with cells unfinished.
    under_torchrun = "LOCAL_RANK" in os.environ
    if under_torchrun or jobs == 1:
        go = work_together if under_torchrun else work
        with progress(1, f"{len(unfinished(plan))} cells") as bar:
            task = bar.task_ids[0]
            go(plan, lambda words, done, total: bar.update(task, description=words, completed=done, total=total))
    else:
        _watch_workers(plan, jobs or len(os.sched_getaffinity(0)))
    results = read_results(plan.folder) if (plan.folder / TABLE).is_file() else []
    write_csv(results, plan.folder / CSV)
    _tell(plan, refusals(plan), len(unfinished(plan)), as_json=as_json)


def _train_side_by_side(plan: "Sweep") -> None:
    from training.sweep.streams import Progress, train_side_by_side

    with progress(1, "training") as bar:

        def watch(found: Progress) -> None:
            words = f"training: {found.ended} of {found.begun} begun"
            bar.update(bar.task_ids[0], description=words, completed=found.steps, total=found.all_steps)

        train_side_by_side(plan, watch)


def _watch_workers(plan: "Sweep", jobs: int) -> None:
    from training.sweep.workers import start_workers, unfinished

    total = len(plan.cells)
    workers = start_workers(plan, min(jobs, max(len(unfinished(plan)), 1)))
    try:
        with progress(total, "cells") as bar:
            while any(worker.is_alive() for worker in workers):
                bar.update(bar.task_ids[0], completed=total - len(unfinished(plan)))
                time.sleep(LOOK_S)
    finally:
        for worker in workers:
            worker.terminate()


def _tell(plan: "Sweep", refused: dict[str, str], left: int, *, as_json: bool) -> None:
    for key, words in refused.items():
        typer.echo(f"left out {key}: {words}", err=True)
    summary = {"sweep": str(plan.folder), "cells": len(plan.cells), "unfinished": left, "refused": refused}
    typer.echo(
        json.dumps(summary) if as_json else f"{len(plan.cells) - left} of {len(plan.cells)} cells in {plan.folder}"
    )
    if left:
        raise typer.Exit(BAD_INPUT_STATUS if refused else FAULT_STATUS)
