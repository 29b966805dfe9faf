"""Figures of a benchmark, each with what it has to reach."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import typer


@dataclass(frozen=True)
class Figure:
    """One measured figure.

    Attributes:
        name: what was measured.
        value: as people read it, with its unit.
        target: what it has to reach; empty when it is told for its own sake.
        reached: whether it does.
    """

    name: str
    value: str
    target: str = ""
    reached: bool | None = None

    @property
    def verdict(self) -> str:
        """For people."""
        return "" if self.reached is None else "reached" if self.reached else "NOT REACHED"

    def line(self) -> str:
        """The figure on one line."""
        asked = f" ({self.target}: {self.verdict})" if self.target else ""
        return f"{self.name:44s} {self.value}{asked}"

    def record(self) -> dict[str, Any]:
        """For a file."""
        return asdict(self)


def at_most(name: str, value: float, limit: float, unit: str = "", digits: int = 2) -> Figure:
    """A figure that has to stay below a limit."""
    return Figure(name, f"{value:.{digits}f}{unit}", f"below {limit:g}{unit}", bool(value < limit))


def at_least(name: str, value: float, limit: float, unit: str = "", digits: int = 2) -> Figure:
    """A figure that has to come up to a limit."""
    return Figure(name, f"{value:.{digits}f}{unit}", f"{limit:g}{unit} or more", bool(value >= limit))


def holds(name: str, value: str, target: str, *, reached: bool) -> Figure:
    """Something that is so or is not."""
    return Figure(name, value, target, bool(reached))


def told(name: str, value: str) -> Figure:
    """A figure for its own sake."""
    return Figure(name, value)


def say(figures: Iterable[Figure]) -> None:
    """Print them."""
    for figure in figures:
        typer.echo(figure.line())
