"""The command evaluate: a model on held-out masks beside interpolation without one."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.errors import InvalidParameter
from training.choices import OTHER_SPLIT, RegimeName, SplitName
from training.cohort_options import opened_cohort, takes_cohort
from training.cohorts import CohortOptions
from training.cohorts.sources import CohortSource
from training.console import JsonOption, exit_status, progress, tell_findings
from training.outputs import ForceOption, check_new_files

if TYPE_CHECKING:
    from model.bundle import ShapeModel
    from training.cohorts import Case
    from training.evaluate import Measurement
    from training.sparsify import Regime


@takes_cohort
def evaluate(
    source: CohortSource,
    options: CohortOptions,
    model: Annotated[str, typer.Option(help="Name of a shipped model, or the folder of a bundle.")],
    split: Annotated[SplitName, typer.Option(help="Which held-out cases.")] = SplitName.TEST,
    regime: Annotated[list[RegimeName] | None, typer.Option(help="May repeat; thin, thick and orthogonal.")] = None,
    offset: Annotated[int | None, typer.Option(min=0, help="First drawn slice; centred when left out.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Measure only so many cases.")] = None,
    output: Annotated[Path | None, typer.Option(help="CSV file with every case.")] = None,
    record: Annotated[bool, typer.Option("--record", help="Write the figures into the bundle's manifest.")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure a model on held-out masks, beside interpolation without a model."""
    with exit_status():
        from training.evaluate import find_bundle, open_named, shipped_bundles
        from training.report import as_json as json_of
        from training.report import as_text, record_accuracy, summarise, write_csv
        from training.seen import check_uncalibrated, check_unseen

        if output is not None:
            check_new_files(output, force=force)
        if offset is not None and not {RegimeName.THIN, RegimeName.THICK} & set(regime or RegimeName):
            raise InvalidParameter(
                "--offset would do nothing here; it goes with the regimes thin and thick.", part="offset"
            )
        if record and (limit is not None or offset is not None):
            raise InvalidParameter(
                "A manifest holds figures of all cases with slices that are centred on the object; --record is "
                "accepted without --limit and --offset.",
                part="record",
            )
        opened = open_named(model)
        found = opened_cohort(source, options)
        tell_findings(found)
        cases = found.of_split(split.value)[:limit]
        if not cases:
            raise InvalidParameter(f"The cohort has no {split} cases; {OTHER_SPLIT[split]}.", part="split")
        check_unseen(opened.manifest, cases, split.value)
        if split is SplitName.TEST:
            check_uncalibrated(opened.manifest, cases)
        regimes = tuple(regime or (RegimeName.THIN, RegimeName.THICK, RegimeName.ORTHOGONAL))
        measured = _evaluate_with_progress(opened, cases, regimes, offset, options.seed)
        if output is not None:
            output.parent.mkdir(parents=True, exist_ok=True)
            with output.open("w", newline="", encoding="utf-8") as stream:
                write_csv(measured, stream)
        rows = summarise(measured)
        if record:
            record_accuracy(find_bundle(model, [shipped_bundles()]), rows, split.value)
        typer.echo(json_of(rows) if as_json else as_text(rows))


def _evaluate_with_progress(
    model: "ShapeModel", cases: "Sequence[Case]", regimes: Sequence[RegimeName], offset: int | None, seed: int
) -> "list[Measurement]":
    from training.evaluate import evaluate as measure_all
    from training.evaluate import methods_for

    names: list[Regime] = [regime.value for regime in regimes]
    total = len(cases) * sum(len(methods_for(name)) for name in names)
    with progress(total, f"measuring {model.manifest.name}") as bar:
        return measure_all(
            model, cases, names, offset=offset, seed=seed, watch=lambda found: bar.advance(bar.task_ids[0])
        )
