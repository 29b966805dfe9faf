"""The table of results: one line of JSON a cell, appended under a lock."""

import fcntl
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from model.errors import InvalidParameter

TABLE = "results.jsonl"


@dataclass(frozen=True)
class Result:
    """What a cell came to.

    Attributes:
        key: of the cell; the fields after it are the cell's.
        cohort, source, licence: of the shapes.
        shippable: whether weights, and so pictures, of these shapes may be published.
        shapes: of the training.
        steps: optimiser steps that were asked for; fewer are run where early stopping ends them.
        seconds: of the last attempt at the cell.
        sigmas: of the base, largest first.
        active: dimensions for 95, 97 and 99 % of the base variance.
        latent, surface_mm: of the generated shapes, see `training.generation`.
        measured: by regime and case the figures of `training.report`; None where the drawing could not be taken.
    """

    key: str
    regime: str
    latent_size: int
    prior: str
    seed: int
    objective: str
    cohort: str
    source: str
    licence: str
    shippable: bool
    shapes: int
    steps: int
    seconds: float
    sigmas: list[float]
    active: list[int]
    latent: list[float] = field(default_factory=list)
    surface_mm: list[float] = field(default_factory=list)
    measured: dict[str, dict[str, dict[str, float] | None]] = field(default_factory=dict)


def read_results(folder: Path) -> list[Result]:
    """Results of a sweep's folder, the last of each cell; a line that a kill cut short is passed over.

    Raises:
        InvalidParameter: the folder holds no table.
    """
    path = folder / TABLE
    if not path.is_file():
        raise InvalidParameter(
            "The folder holds no results; one written by morphoflow sweep is accepted.", part="sweep"
        )
    found: dict[str, Result] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            values: dict[str, Any] = json.loads(line)
            found[values["key"]] = Result(**values)
        except (ValueError, TypeError, KeyError):
            continue
    return list(found.values())


def done(folder: Path) -> set[str]:
    """Keys of the cells that have a result."""
    return {result.key for result in read_results(folder)} if (folder / TABLE).is_file() else set()


def append(folder: Path, result: Result) -> None:
    """Add a line; several processes may do so at a time."""
    line = json.dumps(asdict(result)) + "\n"
    with (folder / TABLE).open("a+b") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        if stream.tell() and not _ends_with_newline(folder / TABLE):
            stream.write(b"\n")
        stream.write(line.encode())


def _ends_with_newline(path: Path) -> bool:
    return path.read_bytes()[-1:] == b"\n"
