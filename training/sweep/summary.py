"""Figures of a result: means with SD, the correlation of its generated shapes; and all of them as CSV."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from training.generation import Generation
from training.report import FIGURES, spread
from training.sweep.table import Result

CSV = "results.csv"


def correlation(result: Result) -> float:
    """Pearson's r of distance in z0 and surface distance over the generated shapes."""
    return Generation(np.array(result.latent, float), np.array(result.surface_mm, float)).pearson


def write_csv(results: Sequence[Result], path: Path) -> None:
    """One row a cell and regime of measurement: means, population SDs, counts and correlations."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, list(row_of(None, "")), lineterminator="\n")
        writer.writeheader()
        for result in sorted(results, key=lambda one: (one.cohort, one.regime, one.latent_size, one.prior, one.seed)):
            for regime in result.measured:
                writer.writerow(row_of(result, regime))


def row_of(result: Result | None, regime: str) -> dict[str, object]:
    """A row of the CSV file; its column names for no result."""
    columns = ["cohort", "trained_on", "latent_size", "prior", "objective", "seed", "measured_in", "shapes", "steps"]
    figures = [f"{name}_{part}" for name in FIGURES for part in ("mean", "sd")]
    rest = ["cases", "failed", "active_95", "active_97", "active_99", "samples", "r_squared", "pearson_r", "seconds"]
    if result is None:
        return dict.fromkeys([*columns, *figures, *rest])
    values = [found for found in result.measured[regime].values() if found is not None]
    means = {name: spread([value[name] for value in values]) for name in FIGURES}
    flat = [round(part, 4) for name in FIGURES for part in means[name]]
    pearson = correlation(result)
    own = [result.cohort, result.regime, result.latent_size, result.prior, result.objective, result.seed, regime]
    tail = [len(values), len(result.measured[regime]) - len(values), *result.active, len(result.latent)]
    found = [*own, result.shapes, result.steps, *flat, *tail, round(pearson**2, 4), round(pearson, 4), result.seconds]
    return dict(zip([*columns, *figures, *rest], found, strict=True))
