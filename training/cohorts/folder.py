"""A folder of masks: NIfTI, NRRD or MetaImage with any affine, and optionally ``cases.csv``.

Columns of ``cases.csv`` that are read: ``case`` (file name without suffix), ``split`` (train, validation
or test), ``person`` (or ``subject``), ``source``, ``licence``. A file without a row, or a folder without
the table, takes its split from a folder named train, validation or test, or else train; its person is
its own name. Sub-folders are searched as well.
"""

import csv
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import cast

from model.errors import CohortError, InputError
from training.cohorts.assemble import CohortOptions, assemble
from training.cohorts.cohort import Case, Cohort, Provenance, Refusal, Split
from training.cohorts.reading import MaskFile, is_mask_file, read_mask, stem

Row = Mapping[str, str]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")
OWN_MASKS = Provenance("masks of the caller", "not stated", "", shippable=False)


def read_folder(
    folder: Path,
    options: CohortOptions,
    *,
    name: str | None = None,
    labels: Collection[int] = (),
    provenance: Provenance = OWN_MASKS,
    side: str = "mixed",
) -> Cohort:
    """Every mask below a folder as a cohort.

    Raises:
        CohortError: no folder, a table that cannot be used, or what `assemble` refuses.
    """
    if not folder.is_dir():
        raise CohortError("The folder of masks does not exist; an existing folder is accepted.")
    rows = read_table(folder / "cases.csv")
    files = sorted(path for path in folder.rglob("*") if path.is_file() and is_mask_file(path))
    cases, refused = read_cases(files, rows, labels)
    absent = rows.keys() - {stem(path) for path in files}
    refused += [Refusal(case, "the table lists it but its file is missing") for case in sorted(absent)]
    return assemble(name or folder.resolve().name, cases, refused, provenance, options, side=side)


def read_table(path: Path, keep: Callable[[Row], bool] = lambda row: True) -> dict[str, Row]:
    """Rows of ``cases.csv`` by case, those that pass ``keep``; none when there is no such file.

    Raises:
        CohortError: no column ``case``, a case twice, or an unknown split.
    """
    if not path.is_file():
        return {}
    with path.open(newline="", encoding="utf-8-sig") as stream:
        rows = list(csv.DictReader(stream))
    names = [row.get("case") or "" for row in rows]
    if "" in names or len(set(names)) < len(names):
        raise CohortError(
            "The table of cases has a row without a case or a case twice; one row for each case is accepted."
        )
    if any((row.get("split") or "train") not in SPLITS for row in rows):
        raise CohortError("The table of cases names an unknown split; train, validation or test is accepted.")
    return {row["case"]: row for row in rows if keep(row)}


def read_cases(
    files: Collection[Path],
    rows: Mapping[str, Row],
    labels: Collection[int] = (),
    read: Callable[[Path], MaskFile] | None = None,
) -> tuple[list[Case], list[Refusal]]:
    """Cases of the files that can be read, and refusals of those that cannot; ``read`` makes a mask of a file."""
    cases: list[Case] = []
    refused: list[Refusal] = []
    taken: set[str] = set()
    for path in files:
        case_name = stem(path)
        if case_name in taken:
            refused.append(
                Refusal(f"{case_name} ({path.parent.name})", "another file has the same name, one is accepted")
            )
            continue
        taken.add(case_name)
        try:
            found = read(path) if read is not None else read_mask(path, labels)
            cases.append(_case(path, rows.get(case_name, {}), found))
        except InputError as error:
            refused.append(Refusal(case_name, str(error)))
    return cases, refused


def _case(path: Path, row: Row, found: MaskFile) -> Case:
    name = stem(path)
    by_folder = next((split for split in SPLITS if path.parent.name == split), "train")
    split = cast(Split, row.get("split") or by_folder)
    person = row.get("person") or row.get("subject") or name
    return Case(name, person, split, found.mask, found.grid, found.findings)
