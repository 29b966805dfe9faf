"""Whole lumbar vertebrae L1 to L5 from CT, all levels mixed, in the scanner's pose; grids of 1 mm.

The rows of source ``verse`` derive from VerSe and may be shipped; origin and licence of the others
(``lumase``) are not stated, so that they serve benchmarks alone.
"""

from pathlib import Path

from training.cohorts.assemble import CohortOptions
from training.cohorts.cohort import Cohort, Provenance
from training.cohorts.folder import Row
from training.cohorts.published import read_published

SHIPPABLE_SOURCE = "verse"
VERSE = Provenance(
    source="VerSe",
    licence="CC BY-SA 4.0",
    attribution="VerSe (Sekuboyina et al., Medical Image Analysis 73, 2021; Löffler et al., Radiology: AI 2, 2020)",
    shippable=True,
)
MIXED = Provenance(
    source="VerSe, and masks of unstated origin",
    licence="not stated in part: benchmark only",
    attribution=VERSE.attribution,
    shippable=False,
)


def load(root: Path, options: CohortOptions) -> Cohort:
    """Masks below ``root/vertebra``; with ``shippable_only`` those of VerSe alone.

    Raises:
        CohortError: not there, or not fit to be used.
    """
    folder = root / "vertebra"
    if options.shippable_only:
        return read_published(folder, options, VERSE, side="unpaired", keep=_from_verse)
    return read_published(folder, options, MIXED, side="unpaired")


def _from_verse(row: Row) -> bool:
    return row.get("source") == SHIPPABLE_SOURCE
