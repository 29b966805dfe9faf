"""Figures of a generator, their targets, and the page that shows both."""

import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One figure; with a limit it is a target as well.

    Attributes:
        words: what it is, with its unit.
        value: NaN where there is none.
        note: what a reader should know.
        limit: what is to be reached; `at_most` says on which side.
    """

    words: str
    value: float
    note: str = ""
    limit: float | None = None
    at_most: bool = True

    @property
    def reached(self) -> bool | None:
        """Whether the limit was reached; None where there is none."""
        if self.limit is None:
            return None
        if math.isnan(self.value):
            return False
        return self.value <= self.limit if self.at_most else self.value >= self.limit


def markdown(title: str, figures: Sequence[Figure]) -> str:
    """A table, one line a figure."""
    lines = [f"### {title}", "", "| | figure | to reach | |", "| --- | --- | --- | --- |"]
    for figure in figures:
        wanted = "" if figure.limit is None else f"{'at most' if figure.at_most else 'at least'} {figure.limit:g}"
        verdict = {None: "", True: "reached", False: "**not reached**"}[figure.reached]
        words = figure.words + (f" ({figure.note})" if figure.note else "")
        lines.append(f"| {words} | {figure.value:.4g} | {wanted} | {verdict} |")
    return "\n".join(lines) + "\n"
