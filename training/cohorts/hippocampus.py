"""Hippocampi from brain MR: Medical Segmentation Decathlon, Task04.

Labels 1 (anterior) and 2 (posterior) together are the object. Grids of 1 mm, cropped tightly. The
anatomical side is not recorded.
"""

from pathlib import Path

from training.cohorts.assemble import CohortOptions
from training.cohorts.cohort import Cohort, Provenance
from training.cohorts.published import read_published

PROVENANCE = Provenance(
    source="Medical Segmentation Decathlon, Task04 Hippocampus",
    licence="CC BY-SA 4.0",
    attribution="Medical Segmentation Decathlon (Antonelli et al., Nature Communications 13, 2022), "
    "hippocampus masks from Vanderbilt University Medical Center",
    shippable=True,
)


def load(root: Path, options: CohortOptions) -> Cohort:
    """Masks below ``root/hippocampus``.

    Raises:
        CohortError: not there, or not fit to be used.
    """
    return read_published(root / "hippocampus", options, PROVENANCE, side="mixed")
