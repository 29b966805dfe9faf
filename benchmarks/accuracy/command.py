"""The project beside what it competes with, in one run on held-out shapes.

Every cell (cohort, case, drawing, method) is written as soon as it is measured; a run that was ended goes on where it
stopped. At the end: ``table.md``, ``cells.csv``, the targets on standard output, and pictures.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.accuracy.cells import Cell, CellFile
from benchmarks.accuracy.drawings import DrawingName
from benchmarks.accuracy.measuring import Task, measure_all
from benchmarks.accuracy.methods import Sources, has_fidelity
from benchmarks.accuracy.names import MethodName
from benchmarks.accuracy.page import picture_lines, with_generated
from benchmarks.accuracy.plan import CohortPlan, chosen_cases, keys_of, tasks_of, without
from benchmarks.accuracy.summary import summarise, write_csv
from benchmarks.accuracy.table import as_markdown
from benchmarks.accuracy.targets import targets_of
from model.bundle import MANIFEST, open_bundle, read_manifest
from model.errors import InvalidParameter
from training.baselines.distance_choice import kept
from training.choices import SplitName
from training.cohort_options import DataOption
from training.cohorts import CohortName, CohortOptions, data_folder, load_cohort
from training.console import exit_status, progress

SHIPPED = Path("model/bundles")
#: What ``build/baselines`` does not hold yet is learned and chosen first, which takes minutes a cohort.
CACHE = Path("build/baselines")
OUTPUT = Path("results/accuracy")
PICTURED = (DrawingName.ORTHOGONAL, DrawingName.THIN)


def main(
    cohort: Annotated[list[CohortName] | None, typer.Option(help="May repeat; those with a model.")] = None,
    model: Annotated[list[str] | None, typer.Option(help="COHORT=BUNDLE; may repeat, shipped ones are there.")] = None,
    regimes: Annotated[list[DrawingName] | None, typer.Option(help="Drawings; may repeat, all when left out.")] = None,
    methods: Annotated[list[MethodName] | None, typer.Option(help="May repeat; all but adam when left out.")] = None,
    split: Annotated[SplitName, typer.Option(help="Which held-out cases.")] = SplitName.TEST,
    cases: Annotated[int, typer.Option(min=1, help="Cases of a cohort at most, evenly spaced.")] = 30,
    adam_cases: Annotated[int, typer.Option(min=0, help="First cases for the predecessor, with --methods adam.")] = 2,
    data: DataOption = None,
    output: Annotated[Path, typer.Option(help="Folder of cells, table and pictures.")] = OUTPUT,
    cache: Annotated[Path, typer.Option(help="Folder of what the baselines learned.")] = CACHE,
    docs: Annotated[
        Path | None, typer.Option(help="Page whose generated part is rewritten, pictures beside it.")
    ] = None,
    tag: Annotated[str, typer.Option(help="Keeps runs of different code apart in one output folder.")] = "",
    jobs: Annotated[int, typer.Option(min=1, help="Processes at a time.")] = 1,
    threads: Annotated[int, typer.Option(min=1, help="Threads of a process.")] = 1,
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Whether to draw cases.")] = True,
) -> None:
    """Measure accuracy, time and memory of every method."""
    with exit_status():
        bundles = bundles_of(model or [])
        chosen = cohort or [name for name in CohortName if name in bundles]
        wanted = available(methods or [method for method in MethodName if method is not MethodName.ADAM])
        learned = cache if MethodName.PCA in wanted else None
        plans = [_plan(name, bundles, data, learned, split, cases, adam_cases, threads) for name in chosen]
        tasks = tasks_of(plans, regimes or list(DrawingName), wanted, tag)
        faults = _measure(tasks, CellFile(output / "cells.jsonl"), jobs)
        cells = _report(tasks, CellFile(output / "cells.jsonl"), output)
        shown = _draw(plans, cells, output, docs) if pictures else []
        if docs is not None:
            _write_page(docs, (output / "table.md").read_text(encoding="utf-8"), shown)
        for sentence in faults:
            typer.echo(f"not measured: {sentence}", err=True)
        if faults:
            raise typer.Exit(1)


def bundles_of(named: Sequence[str]) -> dict[str, Path]:
    """Bundle by cohort: the shipped ones of cohorts that are known, and those named as ``cohort=folder``.

    Raises:
        InvalidParameter: a name without a folder.
    """
    found = {name.value: SHIPPED / name for name in CohortName if (SHIPPED / name / MANIFEST).is_file()}
    for words in named:
        name, sign, folder = words.partition("=")
        if not sign or name not in list(CohortName):
            raise InvalidParameter("--model takes COHORT=BUNDLE with the name of a public cohort.", part="model")
        found[name] = Path(folder)
    return found


def available(methods: Sequence[MethodName]) -> list[MethodName]:
    """The methods that this version of the project offers."""
    if MethodName.ALONE in methods and not has_fidelity():
        typer.echo("The model alone is left out: Options has no field fidelity.", err=True)
        return [method for method in methods if method is not MethodName.ALONE]
    return list(methods)


def _plan(
    name: CohortName,
    bundles: dict[str, Path],
    data: Path | None,
    cache: Path | None,
    split: SplitName,
    cases: int,
    adam_cases: int,
    threads: int,
) -> CohortPlan:
    if name not in bundles:
        raise InvalidParameter(f"There is no model of {name}; --model {name}=BUNDLE names one.", part="model")
    found = load_cohort(name, data_folder(data), CohortOptions(skip_refused=True))
    held_out = found.of_split(split.value)
    typer.echo(f"{name}: {min(cases, len(held_out))} of {len(held_out)} {split} cases", err=True)
    sources = Sources(bundles[name], kept(found, cache) if cache is not None else None, threads)
    manifest, _ = read_manifest(bundles[name])
    shippable = found.provenance.shippable and bool(manifest.training.get("weights_may_ship"))
    return CohortPlan(name.value, chosen_cases(held_out, cases), adam_cases, sources, shippable, found.attribution)


def _measure(tasks: Sequence[Task], file: CellFile, jobs: int) -> list[str]:
    left = without(tasks, file.read())
    with progress(len(keys_of(left)), "measuring") as bar:

        def watch(cell: Cell) -> None:
            file.append([cell])
            bar.update(bar.task_ids[0], advance=1, description=f"{cell.key.cohort} {cell.key.method}")

        return measure_all(left, jobs, watch)


def _report(tasks: Sequence[Task], file: CellFile, output: Path) -> list[Cell]:
    """Table and CSV of exactly the cells of this run."""
    there = file.read()
    cells = [there[key] for key in keys_of(tasks) if key in there]
    rows = summarise(cells)
    text = as_markdown(rows, targets_of(rows))
    (output / "table.md").write_text(text + "\n", encoding="utf-8")
    with (output / "cells.csv").open("w", newline="", encoding="utf-8") as stream:
        write_csv(cells, stream)
    typer.echo(text)
    return cells


def _draw(
    plans: Sequence[CohortPlan], cells: Sequence[Cell], output: Path, docs: Path | None
) -> list[tuple[str, Path]]:
    """Pictures; those of cohorts or models that must not be published stay in the output folder."""
    from benchmarks.accuracy.pictures import best_median_worst, save_picture

    found = []
    for plan in plans:
        model = open_bundle(plan.sources.bundle, threads=plan.sources.threads)
        mine = [cell for cell in cells if cell.key.cohort == plan.name]
        for drawing in PICTURED:
            choices = best_median_worst(mine, drawing)
            folder = docs.parent if docs is not None and plan.shippable else output
            path = folder / "pictures" / f"{plan.name}-{drawing}.png"
            if choices:
                save_picture(model, plan.cases, choices, drawing, path)
            if choices and folder is not output:
                found.append((f"{plan.name.capitalize()}, {drawing} (masks: {plan.attribution})", path))
    return found


def _write_page(page: Path, table: str, pictures: Sequence[tuple[str, Path]]) -> None:
    parts = [table, picture_lines(pictures, page.parent)]
    text = with_generated(page.read_text(encoding="utf-8"), "\n\n".join(part for part in parts if part))
    page.write_text(text, encoding="utf-8")
