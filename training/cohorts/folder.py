"""A folder of masks: NIfTI, NRRD or MetaImage with any affine, and optionally ``cases.csv``.

Columns of ``cases.csv`` that are read: ``case`` (file name without suffix), ``split`` (train, validation
or test), ``person`` (or ``subject``, or ``patient``), ``source``, ``licence``. A file without a row, or a folder
without the table, takes its split from the innermost folder on the way to it that is named after one (`SPLITS`), or
else train; its person is its own name. Sub-folders are searched as well.
"""

import csv
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import cast

from model.errors import CohortError, InputError
from training.cohorts.assemble import CohortOptions, assemble
from training.cohorts.cohort import NOT_STATED, Case, Cohort, Provenance, Refusal, Split, listed
from training.cohorts.reading import SUFFIXES, MaskFile, is_mask_file, read_mask, stem

Row = Mapping[str, str]
#: Columns that say whose a case is, the first that is there; and what else is read.
PERSON, READ = ("person", "subject", "patient"), ("case", "split", "source", "licence")
#: Splits by the names that folders and tables may give them, in small letters.
SPLITS: Mapping[str, Split] = {
    "train": "train",
    "training": "train",
    "validation": "validation",
    "val": "validation",
    "valid": "validation",
    "test": "test",
    "testing": "test",
}
#: Formats of tables, and of images and label maps, that are not read.
TABLES = (".csv", ".tsv", ".txt", ".xlsx", ".xls", ".ods")
OTHER_IMAGES = (".mgz", ".mgh", ".hdr", ".dcm", ".tif", ".tiff", ".npy", ".npz", ".vti", ".minc", ".mnc")
#: What may stand between two columns.
SEPARATORS = ",;\t"
OWN_MASKS = Provenance("masks of the caller", "not stated", "", shippable=False)


def read_folder(
    folder: Path,
    options: CohortOptions,
    *,
    name: str | None = None,
    labels: Collection[int] = (),
    provenance: Provenance = OWN_MASKS,
    side: str = NOT_STATED,
) -> Cohort:
    """Every mask below a folder as a cohort.

    Raises:
        CohortError: no folder, a table that cannot be used, or what `assemble` refuses.
    """
    if not folder.is_dir():
        raise CohortError("The folder of masks does not exist; an existing folder is accepted.")
    rows = own_table(folder)
    found = [path for path in folder.rglob("*") if path.is_file()]
    files = sorted(path for path in found if is_mask_file(path))
    cases, refused = read_cases(files, folder, rows, labels)
    refused += [*absent(rows, map(stem, files)), *unread_files(found, OTHER_IMAGES, ", ".join(SUFFIXES))]
    return assemble(name or folder.resolve().name, cases, refused, provenance, options, side=side)


def own_table(folder: Path, *, persons: bool = True) -> dict[str, Row]:
    """Rows of the one table ``cases.csv`` at the top of a folder by case; see `read_table`.

    Raises:
        CohortError: also when there is a table elsewhere in the folder, which would not be read.
    """
    tables = [path for path in folder.rglob("*") if path.suffix.lower() in TABLES and path.stem.lower() == "cases"]
    unread = [path.relative_to(folder).as_posix() for path in tables if path != folder / "cases.csv"]
    if unread:
        raise CohortError(
            f"The folder holds {listed(sorted(unread))}, which is not read; one table cases.csv, at the top of the "
            "folder, is accepted."
        )
    return read_table(folder / "cases.csv", persons=persons)


def read_table(path: Path, keep: Callable[[Row], bool] = lambda row: True, *, persons: bool = True) -> dict[str, Row]:
    """Rows of ``cases.csv`` by case, those that pass ``keep``; none when there is no such file.

    Columns are named in any case and parted by commas, semicolons or tabs.

    Args:
        persons: whether the table alone says whose a case is.

    Raises:
        CohortError: no table in UTF-8, no column ``case``, a case twice, an unknown split, or columns that are not
            read where none says whose a case is.
    """
    if not path.is_file():
        return {}
    columns, rows = _parsed(path)
    if not columns:
        return {}
    names = [row.get("case") or "" for row in rows]
    if "case" not in columns:
        raise CohortError(
            f"The table of cases has no column case, its columns are {listed(columns)}; case, person and split are "
            "accepted."
        )
    if "" in names or len(set(names)) < len(names):
        raise CohortError(
            "The table of cases has a row without a case or a case twice; one row for each case is accepted."
        )
    unknown = sorted({row["split"] for row in rows if row.get("split")} - set(SPLITS))
    if unknown:
        raise CohortError(
            f"The table of cases names an unknown split, {listed(unknown)}; train, validation or test is accepted."
        )
    unread = [column for column in columns if column and column not in (*PERSON, *READ)]
    if persons and unread and not any(column in PERSON for column in columns):
        raise CohortError(
            f"The table of cases has no column person, and {listed(unread)} is not read, so that cases of one person "
            "could stand in several splits; a column person, subject or patient is accepted."
        )
    read = ({**row, "split": SPLITS[row["split"]]} if row.get("split") else row for row in rows)
    return {row["case"]: row for row in read if keep(row)}


def _parsed(path: Path) -> tuple[list[str], list[Row]]:
    """Columns in small letters, and the rows by them, splits in small letters as well."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            head = stream.readline()
            stream.seek(0)
            reader = csv.reader(stream, delimiter=max(SEPARATORS, key=head.count), strict=True)
            lines = [[cell.strip() for cell in line] for line in reader if any(cell.strip() for cell in line)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise CohortError(
            "The table of cases cannot be read; text in UTF-8 with columns between commas or semicolons is accepted."
        ) from error
    columns = [column.lower() for column in lines[0]] if lines else []
    if any(cell for line in lines[1:] for cell in line[len(columns) :]):
        raise CohortError("The table of cases has a row of more cells than columns; one cell a column is accepted.")
    rows = [dict(zip(columns, line, strict=False)) for line in lines[1:]]
    return columns, [row | {"split": row["split"].lower()} if "split" in row else row for row in rows]


def merged(known: Mapping[str, Row], table: Mapping[str, Row]) -> dict[str, Row]:
    """Rows of both by case; a cell of the table that is not empty goes before what was known."""
    return {
        name: {**known.get(name, {}), **{column: cell for column, cell in table.get(name, {}).items() if cell}}
        for name in (*known, *(name for name in table if name not in known))
    }


def absent(rows: Iterable[str], known: Iterable[str]) -> list[Refusal]:
    """Cases that a table lists and no file holds.

    Args:
        known: names of the files without their suffix, and whatever else a row may be named after.
    """
    reason = "the table lists it but its file is missing; names of files without their suffix are accepted"
    return [Refusal(case, reason) for case in sorted(set(rows) - set(known))]


def unread_files(files: Iterable[Path], suffixes: Collection[str], accepted: str) -> list[Refusal]:
    """Files of shapes whose format is not read, each left out by its name."""
    reason = f"files of this format are not read; {accepted} are accepted"
    others = [path for path in files if path.name.lower().endswith(tuple(suffixes)) and not path.name.startswith(".")]
    return [Refusal(path.name, reason, stops=False) for path in sorted(others)]


def read_cases(
    files: Collection[Path],
    root: Path,
    rows: Mapping[str, Row],
    labels: Collection[int] = (),
    read: Callable[[Path], MaskFile] | None = None,
) -> tuple[list[Case], list[Refusal]]:
    """Cases of the files that can be read, and refusals of those that cannot.

    Args:
        root: folder of the cohort, below which folders may say the split.
        rows: what is known of a case by its name.
        read: makes a mask of a file; `read_mask` of the labels when None.
    """
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
            cases.append(_case(path, root, rows.get(case_name, {}), found))
        except InputError as error:
            refused.append(Refusal(case_name, str(error)))
    return cases, refused


def _case(path: Path, root: Path, row: Row, found: MaskFile) -> Case:
    name = stem(path)
    split = cast(Split, row.get("split") or split_by_folder(path, root))
    person = next((row[column] for column in PERSON if row.get(column)), name)
    return Case(name, person, split, found.mask, found.grid, found.findings)


def split_by_folder(path: Path, root: Path) -> Split:
    """Split of a file by the innermost folder below the root that is named after one, train when none is."""
    folders = [part.lower() for part in path.relative_to(root).parts[:-1]]
    return next((SPLITS[part] for part in reversed(folders) if part in SPLITS), "train")
