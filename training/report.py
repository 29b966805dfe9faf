"""Measurements as tables: a summary in text or JSON, every case in CSV."""

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from io import TextIOBase
from pathlib import Path

import numpy as np

from model.bundle import read_manifest, write_manifest
from training.evaluate import Measurement, Method
from training.sparsify import Regime

#: Of a reconstruction, by the names of `training.metrics_masks.MaskAgreement`.
FIGURES = ("dice", "asd_mm", "hd95_mm", "hd_mm")


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation over cases (population formula)."""

    mean: float
    sd: float


@dataclass(frozen=True)
class Row:
    """A method in a regime.

    Attributes:
        cases: measured; `failed` could not be, and are in no mean.
        figures: by the names of `FIGURES`, and ``seconds``.
        asd_ratio, hd95_ratio: the model's mean by this method's mean, over the cases that both could take.
        dice_gain: the model's mean less this method's, over the same cases.
    """

    regime: Regime
    method: Method
    cases: int
    failed: int
    figures: dict[str, Spread]
    asd_ratio: float
    hd95_ratio: float
    dice_gain: float


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Mean and population standard deviation; not numbers where there are no values, or no finite ones."""
    if not values or not np.isfinite(values).all():
        return float(np.mean(values)) if values else math.nan, math.nan
    return float(np.mean(values)), float(np.std(values))


def summarise(measurements: Sequence[Measurement]) -> list[Row]:
    """One row for each regime and method, in the order of their first appearance."""
    keys = dict.fromkeys((found.regime, found.method) for found in measurements)
    return [_row(measurements, regime, method) for regime, method in keys]


def record_accuracy(bundle: Path, rows: Sequence[Row], split: str) -> None:
    """Write the model's mean figures into its bundle's manifest, by regime; those that are not finite are left out.

    Raises:
        BundleError: the manifest cannot be read.
    """
    manifest, _ = read_manifest(bundle)
    measured = {
        f"{split}/{row.regime}": {"cases": float(row.cases)}
        | {name: row.figures[name].mean for name in FIGURES if np.isfinite(row.figures[name].mean)}
        for row in rows
        if row.method == Method.MODEL
    }
    write_manifest(replace(manifest, accuracy={**manifest.accuracy, **measured}), bundle)


def as_text(rows: Sequence[Row]) -> str:
    """A table in plain text, columns aligned; "x" columns are the model's mean by the row's mean."""
    head = [
        "regime",
        "method",
        "cases",
        "failed",
        "Dice",
        "ASD mm",
        "HD95 mm",
        "HD mm",
        "s/case",
        "ASD x",
        "HD95 x",
        "Dice +",
    ]
    lines = [head, *(_cells(row) for row in rows)]
    widths = [max(len(line[column]) for line in lines) for column in range(len(head))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def as_json(rows: Sequence[Row]) -> str:
    """The summary as a JSON array; figures that do not exist are null."""
    return json.dumps([_finite(asdict(row)) for row in rows], indent=2)


def write_csv(measurements: Sequence[Measurement], stream: TextIOBase) -> None:
    """Every measurement as a line."""
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["case", "regime", "method", *FIGURES, "seconds", "refusal"])
    for found in measurements:
        figures = [getattr(found.agreement, name) if found.agreement else "" for name in FIGURES]
        writer.writerow([found.case, found.regime, found.method.value, *figures, f"{found.seconds:.3f}", found.refusal])


def _row(measurements: Sequence[Measurement], regime: Regime, method: Method) -> Row:
    mine = {found.case: found for found in measurements if (found.regime, found.method) == (regime, method)}
    models = {found.case: found for found in measurements if (found.regime, found.method) == (regime, Method.MODEL)}
    taken = [found for found in mine.values() if found.agreement is not None]
    shared = [name for name, found in mine.items() if found.agreement and name in models and models[name].agreement]
    theirs, ours = ([_values(source[name]) for name in shared] for source in (mine, models))
    figures = {name: Spread(*spread([_values(found)[name] for found in taken])) for name in FIGURES}
    figures["seconds"] = Spread(*spread([found.seconds for found in taken]))
    return Row(
        regime,
        method,
        len(taken),
        len(mine) - len(taken),
        figures,
        _ratio(_mean(ours, "asd_mm"), _mean(theirs, "asd_mm")),
        _ratio(_mean(ours, "hd95_mm"), _mean(theirs, "hd95_mm")),
        _mean(ours, "dice") - _mean(theirs, "dice"),
    )


def _values(found: Measurement) -> dict[str, float]:
    return asdict(found.agreement) if found.agreement else dict.fromkeys(FIGURES, math.nan)


def _mean(values: Sequence[dict[str, float]], name: str) -> float:
    return float(np.mean([value[name] for value in values])) if values else math.nan


def _ratio(one: float, other: float) -> float:
    return one / other if other > 0 else math.nan


def _cells(row: Row) -> list[str]:
    figures = [_pair(row.figures[name]) for name in FIGURES]
    compared = [""] * 3
    if row.method is not Method.MODEL:
        compared = [f"{row.asd_ratio:.2f}", f"{row.hd95_ratio:.2f}", f"{row.dice_gain:+.3f}"]
    return [
        row.regime,
        row.method.value,
        str(row.cases),
        str(row.failed),
        *figures,
        f"{row.figures['seconds'].mean:.2f}",
        *compared,
    ]


def _pair(values: Spread) -> str:
    return f"{values.mean:.3f} ± {values.sd:.3f}"


def _finite(value: object) -> object:
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
