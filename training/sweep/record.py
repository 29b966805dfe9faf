"""What a sweep was made from, kept in its folder so that a report finds the shapes again."""

import json
from dataclasses import asdict, replace
from pathlib import Path

from model.errors import InvalidParameter
from training.cohorts.assemble import CohortOptions
from training.cohorts.catalogue import CohortName
from training.cohorts.sources import CohortSource, LayoutName
from training.cohorts.voxelising import SpaceName

RECORD = "sweep.json"


def write_record(folder: Path, source: CohortSource, options: CohortOptions) -> None:
    """Leave source and options in the folder; paths are made absolute.

    Raises:
        InvalidParameter: the folder holds a sweep of other shapes.
    """
    paths = {name: _absolute(getattr(source, name)) for name in ("masks", "meshes", "data")}
    values = {"source": asdict(source) | paths, "options": asdict(replace(options, seed=0))}
    text = json.dumps(values, indent=2) + "\n"
    path = folder / RECORD
    if path.is_file() and json.loads(path.read_text(encoding="utf-8")) != json.loads(text):
        raise InvalidParameter(
            "The output folder holds a sweep of other shapes; the same ones, or an empty folder, are accepted.",
            part="output",
        )
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def read_record(folder: Path) -> tuple[CohortSource, CohortOptions]:
    """Source and options of the sweep in a folder, with the first seed.

    Raises:
        InvalidParameter: there is none.
    """
    path = folder / RECORD
    if not path.is_file():
        raise InvalidParameter("The folder holds no sweep; one written by morphoflow sweep is accepted.", part="sweep")
    values = json.loads(path.read_text(encoding="utf-8"))
    source = values["source"]
    kinds = {
        "cohort": CohortName,
        "masks": Path,
        "meshes": Path,
        "data": Path,
        "layout": LayoutName,
        "space": SpaceName,
    }
    kept = {
        name: kinds[name](value) if name in kinds and value is not None else value for name, value in source.items()
    }
    kept["labels"] = tuple(kept["labels"])
    return CohortSource(**kept), CohortOptions(**values["options"])


def _absolute(path: Path | None) -> str | None:
    return None if path is None else str(path.resolve())
