"""Ankle bones (talus) from CT, left sides mirrored to right; grids of 1 mm."""

from pathlib import Path

from training.cohorts.assemble import CohortOptions
from training.cohorts.cohort import Cohort, Provenance
from training.cohorts.published import read_published

PROVENANCE = Provenance(
    source="Talocrural shape modeling",
    licence="CC0",
    attribution="Talocrural shape modeling data set, public domain",
    shippable=True,
)


def load(root: Path, options: CohortOptions) -> Cohort:
    """Masks below ``root/talus``.

    Raises:
        CohortError: not there, or not fit to be used.
    """
    return read_published(root / "talus", options, PROVENANCE, side="right")
