"""What commands share: progress on a terminal, files that are not overwritten, output for machines."""

import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from itertools import count, islice
from pathlib import Path
from typing import TypeVar

import typer
from pydantic import BaseModel
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from model.errors import InvalidParameter
from model.inference.reconstruction import Watch

T = TypeVar("T")


@contextmanager
def progress(total: int) -> Iterator[Watch]:
    """A bar on standard error that is told the name of each step as it begins; silent in a pipe."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not sys.stderr.isatty()) as bar:
        task, done = bar.add_task("", total=total), count()

        def step(name: str) -> None:
            bar.update(task, description=name, completed=next(done))

        yield step


@contextmanager
def bar() -> Iterator[Callable[[str, int, int], None]]:
    """A bar on standard error that is told name, items done and items in all; silent in a pipe."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not sys.stderr.isatty()) as shown:
        task = shown.add_task("", total=None)
        yield lambda name, done, total: shown.update(task, description=name, completed=done, total=total or None)


def in_order(work: Callable[[int], T], numbers: Iterable[int], workers: int) -> Iterator[T]:
    """Results of the work on numbers in their order, by several threads; few are begun before they are taken."""
    begun: deque[Future[T]] = deque()
    remaining = iter(numbers)
    with ThreadPoolExecutor(workers) as pool:
        try:
            while True:
                begun.extend(pool.submit(work, number) for number in islice(remaining, workers + 1 - len(begun)))
                if not begun:
                    return
                yield begun.popleft().result()
        finally:
            for future in begun:
                future.cancel()


def require_free(paths: dict[str, Path | None], *, force: bool) -> None:
    """Refuse to overwrite, and refuse folders that are not there, before any work is done.

    Raises:
        InvalidParameter: names the option.
    """
    for option, path in paths.items():
        if path is None:
            continue
        if path.is_dir() or not path.parent.is_dir():
            raise InvalidParameter(f"{option} must name a file in a folder that exists.", part=option)
        if path.exists() and not force:
            raise InvalidParameter(f"{option} names a file that exists; --force overwrites it.", part=option)


@contextmanager
def writing(option: str) -> Iterator[None]:
    """What cannot be written is the caller's to mend.

    Raises:
        InvalidParameter: names the option and the system's reason.
    """
    try:
        yield
    except OSError as fault:
        reason = os.strerror(fault.errno) if fault.errno else "the system refuses it"
        raise InvalidParameter(f"{option} cannot be written: {reason}.", part=option) from fault


def require_suffix(option: str, path: Path | None, suffixes: tuple[str, ...]) -> str:
    """The accepted suffix that a file name ends with, without its dot; the empty string for no path.

    Raises:
        InvalidParameter: it ends with none of them.
    """
    if path is None:
        return ""
    for suffix in suffixes:
        if path.name.lower().endswith(f".{suffix}"):
            return suffix
    accepted = ", ".join(f".{suffix}" for suffix in suffixes)
    raise InvalidParameter(f"{option} must end with one of: {accepted}.", part=option)


def echo_json(document: BaseModel) -> None:
    """One JSON document on standard output."""
    typer.echo(document.model_dump_json(indent=1))
