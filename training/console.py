"""What the training commands have in common: exit status, cohorts from options, progress on a terminal."""

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from model.errors import CohortError, InputError, InvalidParameter, MorphoFlowError, NotFound
from training.cohorts import Cohort, CohortName, CohortOptions, data_folder, load_cohort, read_folder

#: Errors that the caller can mend.
BAD_INPUT = (InputError, CohortError, NotFound)
BAD_INPUT_STATUS, FAULT_STATUS = 2, 1


@contextmanager
def exit_status() -> Iterator[None]:
    """Turn the project's errors, and libraries that are not there, into a sentence and an exit status."""
    try:
        yield
    except MorphoFlowError as error:
        typer.echo(f"morphoflow: {error}", err=True)
        raise typer.Exit(BAD_INPUT_STATUS if isinstance(error, BAD_INPUT) else FAULT_STATUS) from error
    except ModuleNotFoundError as error:
        library = (error.name or "a library").split(".")[0]
        typer.echo(f"morphoflow: this command needs {library}: pip install 'morphoflow[training]'", err=True)
        raise typer.Exit(BAD_INPUT_STATUS) from error


@contextmanager
def progress(total: int, words: str) -> Iterator[Progress]:
    """A bar of one task, shown on a terminal only."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        bar.add_task(words, total=total)
        yield bar


def open_cohort(
    name: CohortName | None, masks: Path | None, data: Path | None, options: CohortOptions, labels: Sequence[int]
) -> Cohort:
    """The public cohort or the folder of masks that was asked for.

    Raises:
        InvalidParameter: none or both were named.
        CohortError: it cannot be used.
    """
    if (name is None) == (masks is None):
        raise InvalidParameter("Either --cohort or --masks must be given; one of them is accepted.", part="cohort")
    if name is not None:
        return load_cohort(name, data_folder(data), options)
    if options.shippable_only:
        raise InvalidParameter("A folder of masks has no licence; --shippable goes with --cohort.", part="shippable")
    return read_folder(Path(masks or ""), options, labels=labels)


def tell_findings(cohort: Cohort) -> None:
    """Write to standard error what was left out and what is peculiar."""
    sizes = f"{len(cohort.train)} train, {len(cohort.validation)} validation, {len(cohort.test)} test"
    typer.echo(f"{cohort.name}: {sizes}", err=True)
    for refusal in cohort.refused:
        typer.echo(f"left out {refusal.name}: {refusal.reason}", err=True)
    for words, count in finding_counts(cohort).items():
        typer.echo(f"{count} mask(s) with {words}", err=True)


def finding_counts(cohort: Cohort) -> dict[str, int]:
    """How many masks show each kind of peculiarity."""
    kinds = {
        "speck": "specks apart from the main part (taken off for training)",
        "large parts": "several large parts",
        "face(s) of the crop": "an object that touches the border of the crop",
        "are equal": "equal neighbouring slices (thick slices)",
        "no orientation": "no orientation in the header",
    }
    found = Counter(
        words for case in cohort.cases for sign, words in kinds.items() if any(sign in text for text in case.findings)
    )
    return dict(found)
