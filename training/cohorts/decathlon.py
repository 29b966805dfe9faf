"""A task of the Medical Segmentation Decathlon: ``dataset.json`` beside ``imagesTr/`` and ``labelsTr/``.

``training`` in the description lists pairs of image and label; a description without the list (nnU-Net's) stands for
all of ``labelsTr/``. The test images of the challenge have no labels; where there is a folder ``labelsTs/`` its masks
are the test split. A case is taken for a person of its own unless ``cases.csv`` says otherwise.
"""

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from model.errors import CohortError
from training.cohorts.assemble import CohortOptions, assemble
from training.cohorts.cohort import Cohort, Provenance, Refusal
from training.cohorts.folder import absent, merged, own_table, read_cases
from training.cohorts.reading import is_mask_file, stem

DESCRIPTION = "dataset.json"


def read_decathlon(folder: Path, options: CohortOptions, *, labels: Collection[int] = ()) -> Cohort:
    """The labelled cases of a task.

    Args:
        labels: of the object; any non-zero one when none are named.

    Raises:
        CohortError: no description, one that is not understood, or what `assemble` refuses.
    """
    facts = _description(folder / DESCRIPTION)
    listed = _listed(facts)
    files = _files(folder / "labelsTr") if listed is None else [folder / "labelsTr" / name for name in listed]
    missing = [
        Refusal(stem(path), "the description lists it but its label is missing") for path in files if not path.is_file()
    ]
    tests = _files(folder / "labelsTs")
    table = own_table(folder)
    rows = merged({stem(path): {"split": "test"} for path in tests}, table)
    present = [path for path in files if path.is_file()]
    cases, refused = read_cases([*present, *tests], folder, rows, labels)
    name = str(facts.get("name") or folder.resolve().name).lower()
    refused += [*missing, *absent(table, map(stem, (*files, *tests)))]
    return assemble(name, cases, refused, _provenance(facts), options)


def _description(path: Path) -> Mapping[str, Any]:
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise CohortError(
            "The folder holds no readable dataset.json; a task of the Medical Segmentation Decathlon is accepted."
        ) from error
    if not isinstance(facts, dict):
        raise CohortError("dataset.json is no object; that of the Medical Segmentation Decathlon is accepted.")
    return facts


def _listed(facts: Mapping[str, Any]) -> list[str] | None:
    """File names of the training labels, or None when the description lists none."""
    pairs = facts.get("training")
    if pairs is None:
        return None
    names = (
        [pair.get("label") if isinstance(pair, dict) else None for pair in pairs] if isinstance(pairs, list) else [None]
    )
    if not all(isinstance(name, str) for name in names):
        raise CohortError("dataset.json lists a training case without a label; pairs of image and label are accepted.")
    return [Path(str(name)).name for name in names]


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*") if is_mask_file(path)) if folder.is_dir() else []


def _provenance(facts: Mapping[str, Any]) -> Provenance:
    licence = facts.get("licence") or facts.get("license") or "not stated"
    source = facts.get("description") or facts.get("name") or "a task of the Medical Segmentation Decathlon"
    return Provenance(str(source), str(licence), str(facts.get("reference") or ""), shippable=False)
