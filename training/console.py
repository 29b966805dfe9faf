"""What the training commands have in common: exit status, findings, progress on a terminal."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from model.errors import CohortError, InputError, MorphoFlowError, NotFound
from training.cohorts import Cohort

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
