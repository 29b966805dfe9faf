"""What a sweep is made from and how, kept in its folder: a report finds the shapes again, and all cells are alike."""

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from model.errors import InvalidParameter
from training.cohorts.assemble import CohortOptions
from training.cohorts.sources import CohortSource
from training.difference import first_difference

RECORD = "sweep.json"


def write_record(folder: Path, source: CohortSource, options: CohortOptions, settings: Mapping[str, object]) -> bool:
    """Leave source, options and settings in the folder, or hold them against those that are there.

    Args:
        settings: plain values by the names of their options (`training.sweep.cell.Effort.settings`).

    Returns:
        Whether the folder says with which settings its cells are made; one of an earlier version does not.

    Raises:
        InvalidParameter: the folder holds a sweep of other shapes or settings.
    """
    paths = {name: getattr(source, name) for name in ("masks", "meshes", "data")}
    source = _without_idle_data(replace(source, **{name: value and value.resolve() for name, value in paths.items()}))
    options = replace(options, seed=0)
    if (folder / RECORD).is_file():
        if read_record(folder) != (source, options):
            raise InvalidParameter(
                "The output folder holds a sweep of other shapes; the same ones, or an empty folder, are accepted.",
                part="output",
            )
        return _same_settings(folder, settings)
    folder.mkdir(parents=True, exist_ok=True)
    values = {"source": asdict(source), "options": asdict(options), "settings": dict(settings)}
    # In one move: other processes of the sweep may read it at this moment.
    part = folder / f"{RECORD}.{os.getpid()}.part"
    part.write_text(json.dumps(values, indent=2, default=str) + "\n", encoding="utf-8")
    part.replace(folder / RECORD)
    return True


def _same_settings(folder: Path, settings: Mapping[str, object]) -> bool:
    there = _values(folder).get("settings")
    found = "" if there is None else first_difference(there, settings)
    if found:
        raise InvalidParameter(
            f"The sweep in the output folder has other settings ({found}); the same ones, or an empty folder, are "
            "accepted.",
            part="output",
        )
    return there is not None


def read_record(folder: Path) -> tuple[CohortSource, CohortOptions]:
    """Source and options of the sweep in a folder; its cells name their seeds, here it is 0.

    Raises:
        InvalidParameter: there is none.
    """
    values = _values(folder)
    hints = get_type_hints(CohortSource)
    source = CohortSource(**{name: _as(hints[name], value) for name, value in values["source"].items()})
    return _without_idle_data(source), CohortOptions(**values["options"])


def _without_idle_data(source: CohortSource) -> CohortSource:
    """Without the folder of public cohorts, which the environment may name, where shapes come from elsewhere."""
    return source if source.cohort is not None else replace(source, data=None)


def _as(hint: Any, value: Any) -> Any:
    """A plain value as the type of its field has it: paths, names of enumerations, tuples."""
    if value is None or get_origin(hint) is tuple:
        return None if value is None else tuple(value)
    kinds = [kind for kind in get_args(hint) or (hint,) if issubclass(kind, Path | StrEnum)]
    return kinds[0](value) if kinds else value


def _values(folder: Path) -> dict[str, Any]:
    path = folder / RECORD
    if not path.is_file():
        raise InvalidParameter("The folder holds no sweep; one written by morphoflow sweep is accepted.", part="sweep")
    values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return values
