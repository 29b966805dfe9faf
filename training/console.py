"""What the training commands have in common: exit status, findings, progress on a terminal and in a log."""

import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from model.errors import CohortError, InputError, InvalidParameter, MorphoFlowError, NotFound
from training.cohorts import Cohort
from training.interruption import Stopped

JsonOption = Annotated[bool, typer.Option("--json", help="Write the result as JSON.")]
#: Errors that the caller can mend.
BAD_INPUT = (InputError, CohortError, NotFound)
BAD_INPUT_STATUS, FAULT_STATUS = 2, 1
#: 128 and the number of the signal.
STOPPED_STATUS = 130
#: Where there is no terminal, a line tells how far the work has come, at most so often (s).
LINE_EVERY_S = 60.0


@contextmanager
def exit_status(*, goes_on: str = "the same command goes on") -> Iterator[None]:
    """Turn the project's errors, libraries that are not there and interrupts into a sentence and an exit status.

    Args:
        goes_on: how a training that was stopped is continued.
    """
    try:
        yield
    except Stopped as stopped:
        typer.echo(f"morphoflow: {stopped}; {goes_on}", err=True)
        raise typer.Exit(STOPPED_STATUS) from stopped
    except MorphoFlowError as error:
        typer.echo(f"morphoflow: {error}", err=True)
        raise typer.Exit(BAD_INPUT_STATUS if isinstance(error, BAD_INPUT) else FAULT_STATUS) from error
    except ModuleNotFoundError as error:
        library = (error.name or "a library").split(".")[0]
        typer.echo(f"morphoflow: this command needs {library}: pip install -c constraints.txt '.[training]'", err=True)
        raise typer.Exit(BAD_INPUT_STATUS) from error
    except OSError as error:
        if error.filename is None:
            raise
        typer.echo(f"morphoflow: {error.filename} cannot be read or written: {error.strerror}", err=True)
        raise typer.Exit(BAD_INPUT_STATUS) from error


def check_output(path: Path, *, is_folder: bool) -> None:
    """Whether a file or folder can be written there, told before the work.

    Raises:
        InvalidParameter: something else is in its way, or its folder is write-protected.
    """
    there = next(one for one in (path, *path.parents, Path()) if one.exists())
    blocked = not there.is_dir() if is_folder or there != path else there.is_dir()
    if blocked or not os.access(there, os.W_OK):
        kind = "folder" if is_folder else "file"
        raise InvalidParameter(
            f"The output cannot be written; a {kind} in a folder that can be written to is accepted.", part="output"
        )


def warn(words: str) -> None:
    """Write to standard error what is to be expected; nothing where there are no words."""
    if words:
        typer.echo(f"note: {words}", err=True)


@contextmanager
def progress(total: int, words: str) -> Iterator[Progress]:
    """A bar of one task on a terminal, and lines in a log."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    shown = Progress(*columns, console=console, transient=True) if console.is_terminal else _Lines()
    with shown as bar:
        bar.add_task(words, total=total)
        yield bar


class _Lines(Progress):
    """Tasks that are told of in a line now and then."""

    def __init__(self) -> None:
        super().__init__(disable=True)
        self._told = monotonic()

    def update(self, task_id: TaskID, **changes: Any) -> None:
        super().update(task_id, **changes)
        self._tell(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        super().advance(task_id, advance)
        self._tell(task_id)

    def _tell(self, task_id: TaskID) -> None:
        if monotonic() - self._told < LINE_EVERY_S:
            return
        self._told, task = monotonic(), self._tasks[task_id]
        typer.echo(f"{task.description}: {task.completed:g} of {task.total or 0:g}", err=True)


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
