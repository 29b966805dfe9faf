"""The command report."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.errors import CohortError, InvalidParameter
from training.cohorts.sources import open_cohort
from training.console import JsonOption, exit_status, progress
from training.outputs import ForceOption, check_new_files

if TYPE_CHECKING:
    from training.reporting.page import Chapter

PANELS = 5
#: How the name of a page ends.
PAGES = (".html", ".htm")


def report(
    sweeps: Annotated[list[Path], typer.Argument(help="Folders of sweeps, one a cohort.")],
    output: Annotated[Path, typer.Option(help="HTML file; a CSV file of the same name is written beside it.")],
    title: Annotated[str, typer.Option(help="Heading of the page.")] = "MorphoFlow: tables and panels",
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Whether panels may show shapes of every cohort.")
    ] = True,
    published_only: Annotated[
        bool,
        typer.Option("--published-only", help="Show shapes of those cohorts alone whose licence lets weights ship."),
    ] = False,
    command: Annotated[list[str] | None, typer.Option(help="A line on how the sweeps were made; may repeat.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the paper's tables and figure panels of sweeps as one HTML file and as CSV."""
    with exit_status():
        from training.reporting.page import page
        from training.reporting.tables import write_table

        table = _table_beside(output)
        check_new_files(output, table, force=force)
        _check_sweeps(sweeps)
        with progress(PANELS * len(sweeps), "drawing panels") as bar:
            chapters = [
                _chapter(folder, pictures, published_only, lambda name: bar.advance(bar.task_ids[0]))
                for folder in sweeps
            ]
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(page(title, chapters, command or ()), encoding="utf-8")
        write_table([line for chapter in chapters for line in chapter.lines], table)
        summary = {"page": str(output), "table": str(table), "cohorts": [chapter.cohort for chapter in chapters]}
        typer.echo(json.dumps(summary) if as_json else f"{output} and {table} written")


def _table_beside(output: Path) -> Path:
    """The CSV file that goes with a page.

    Raises:
        InvalidParameter: the page is no HTML file, or the table would lie among those of a sweep.
    """
    from training.sweep.record import RECORD
    from training.sweep.table import TABLE

    if output.suffix.lower() not in PAGES:
        raise InvalidParameter(
            f"The page is written as HTML; a name that ends in {' or '.join(PAGES)} is accepted.", part="output"
        )
    table = output.with_suffix(".csv")
    if any((folder / name).is_file() for folder in table.resolve().parents for name in (RECORD, TABLE)):
        raise InvalidParameter(
            "The page would lie in a sweep's folder, and its table among the sweep's own; another folder is accepted.",
            part="output",
        )
    return table


def _check_sweeps(sweeps: list[Path]) -> None:
    """Every folder holds results, told before anything is drawn."""
    from training.sweep.table import read_results

    for number, folder in enumerate(sweeps, 1):
        fault = "does not exist"
        if folder.is_dir():
            try:
                fault = "" if read_results(folder) else "has no finished cell"
            except InvalidParameter:
                fault = "holds no results"
        if fault:
            name = f"Folder {number} of {len(sweeps)} ({folder.name})"
            raise InvalidParameter(f"{name} {fault}; one written by morphoflow sweep is accepted.", part="sweeps")


def _chapter(folder: Path, pictures: bool, published_only: bool, watch: Callable[[str], None]) -> "Chapter":
    from training.reporting.chapters import chapter_of, pictured_seed
    from training.sweep.record import read_record
    from training.sweep.table import read_results

    results = read_results(folder)
    shown = pictures and (not published_only or all(result.shippable for result in results))
    cohort = None
    if shown:
        try:
            source, options = read_record(folder)
            cohort = open_cohort(source, replace(options, seed=pictured_seed(results)))
        except CohortError as error:
            typer.echo(f"{folder.name}: panels of shapes are left out: {error}", err=True)
    return chapter_of(folder, results, cohort, pictures=shown, watch=watch)
