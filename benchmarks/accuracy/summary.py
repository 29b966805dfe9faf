"""Means over cases and ratios between methods."""

import csv
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from io import TextIOBase

import numpy as np

from benchmarks.accuracy.cells import Cell
from benchmarks.accuracy.drawings import DrawingName
from benchmarks.accuracy.names import MethodName

FIGURES = ("dice", "asd_mm", "hd95_mm", "hd_mm", "fit_s", "seconds", "cpu_s", "peak_mib")


@dataclass(frozen=True)
class Row:
    """A method on a drawing of a cohort.

    Attributes:
        cases, refused: with and without figures.
        mean, deviation: by the names of `FIGURES`, over the cases with figures (population formula).
        asd_ratio: the project's mean ASD by this method's, over the cases that both have.
        fit_ratio, time_ratio: this method's mean seconds by the project's, over the same cases.
    """

    cohort: str
    drawing: DrawingName
    method: MethodName
    cases: int
    refused: int
    mean: dict[str, float]
    deviation: dict[str, float]
    asd_ratio: float
    fit_ratio: float
    time_ratio: float


def summarise(cells: Iterable[Cell]) -> list[Row]:
    """A row for each cohort, drawing and method; drawings and methods in the order of their enumerations."""
    groups: dict[tuple[str, DrawingName, MethodName], list[Cell]] = {}
    for cell in cells:
        groups.setdefault((cell.key.cohort, cell.key.drawing, cell.key.method), []).append(cell)
    cohorts = list(dict.fromkeys(cohort for cohort, _, _ in groups))
    drawings, methods = list(DrawingName), list(MethodName)
    order = sorted(groups, key=lambda g: (cohorts.index(g[0]), drawings.index(g[1]), methods.index(g[2])))
    return [_row(groups[group], groups.get((*group[:2], MethodName.PROJECT), [])) for group in order]


def row_of(rows: Iterable[Row], cohort: str, drawing: DrawingName, method: MethodName) -> Row | None:
    """One of the rows, if it is there and has figures."""
    found = [row for row in rows if (row.cohort, row.drawing, row.method) == (cohort, drawing, method) and row.cases]
    return found[0] if found else None


def _row(mine: Sequence[Cell], project: Sequence[Cell]) -> Row:
    taken = [cell for cell in mine if cell.measured]
    ours = {cell.key.case: cell for cell in project if cell.measured}
    pairs = [(ours[cell.key.case], cell) for cell in taken if cell.key.case in ours]
    key = mine[0].key
    return Row(
        key.cohort,
        key.drawing,
        key.method,
        len(taken),
        len(mine) - len(taken),
        {name: _mean([getattr(cell, name) for cell in taken]) for name in FIGURES},
        {name: _deviation([getattr(cell, name) for cell in taken]) for name in FIGURES},
        _ratio([(our.asd_mm, their.asd_mm) for our, their in pairs]),
        _ratio([(their.fit_s, our.fit_s) for our, their in pairs]),
        _ratio([(their.seconds, our.seconds) for our, their in pairs]),
    )


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def _deviation(values: Sequence[float]) -> float:
    return float(np.std(values)) if values and np.isfinite(values).all() else math.nan


def _ratio(pairs: Sequence[tuple[float, float]]) -> float:
    """Mean of the first ones by the mean of the second ones."""
    upper, lower = _mean([pair[0] for pair in pairs]), _mean([pair[1] for pair in pairs])
    return upper / lower if lower > 0 and math.isfinite(upper) else math.nan


def write_csv(cells: Iterable[Cell], stream: TextIOBase) -> None:
    """Every cell as a line."""
    rows = [{**asdict(cell.key), **{k: v for k, v in asdict(cell).items() if k != "key"}} for cell in cells]
    if rows:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
