"""Distal 100 mm of the femur from CT, left sides mirrored to right; grids of 1 mm.

Every mask touches one face of its crop, where the shaft was cut. Weights trained on these must not ship.
"""

from pathlib import Path

from training.cohorts.assemble import CohortOptions
from training.cohorts.cohort import Cohort, Provenance
from training.cohorts.published import read_published, require_shippable

PROVENANCE = Provenance(
    source="VSD full body bone models v2.0, distal 100 mm",
    licence="CC BY-NC-SA 4.0",
    attribution="VSD full body bone models (Fischer 2023)",
    shippable=False,
)


def load(root: Path, options: CohortOptions) -> Cohort:
    """Masks below ``root/femur``.

    Raises:
        CohortError: not there, not fit to be used, or shippable cases alone were asked for.
    """
    require_shippable(PROVENANCE, options, "femur")
    return read_published(root / "femur", options, PROVENANCE, side="right")
