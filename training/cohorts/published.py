"""What the public cohorts of NIfTI masks with ``train/``, ``test/`` and ``cases.csv`` have in common."""

from collections.abc import Callable
from pathlib import Path

from model.errors import CohortError
from training.cohorts.assemble import CohortOptions, assemble
from training.cohorts.cohort import Cohort, Provenance
from training.cohorts.folder import Row, absent, read_cases, read_table
from training.cohorts.reading import is_mask_file, stem


def read_published(
    folder: Path,
    options: CohortOptions,
    provenance: Provenance,
    *,
    side: str,
    keep: Callable[[Row], bool] = lambda row: True,
) -> Cohort:
    """The cases of the table for which ``keep`` holds; files that the table does not list are not read.

    Raises:
        CohortError: no table there, or what `assemble` refuses.
    """
    rows = read_table(folder / "cases.csv", keep)
    if not rows:
        raise CohortError(
            f"No table of cases for {folder.name} was found below the data folder; name the folder with --data."
        )
    files = sorted(
        path
        for split in ("train", "test")
        for path in (folder / split).glob("*")
        if is_mask_file(path) and stem(path) in rows
    )
    cases, refused = read_cases(files, folder, rows)
    refused += absent(rows, map(stem, files))
    return assemble(folder.name, cases, refused, provenance, options, side=side)


def require_shippable(provenance: Provenance, options: CohortOptions, name: str) -> None:
    """Refuse a cohort whose weights must not ship when only shippable cases were asked for.

    Raises:
        CohortError: the licence keeps weights from shipping.
    """
    if options.shippable_only and not provenance.shippable:
        raise CohortError(
            f"Weights trained on {name} must not be shipped ({provenance.licence}); use it for benchmarks only."
        )
