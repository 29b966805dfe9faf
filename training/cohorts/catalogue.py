"""The named cohorts and where their masks lie."""

import os
from enum import StrEnum
from pathlib import Path

from model.errors import CohortError
from training.cohorts import adrenal, femur, hippocampus, talus, vertebra
from training.cohorts.assemble import CohortOptions
from training.cohorts.cohort import Cohort

#: Names the data folder where no option does.
DATA_VARIABLE = "MORPHOFLOW_DATA"


class CohortName(StrEnum):
    """Public data sets with a module of their own."""

    HIPPOCAMPUS = "hippocampus"
    ADRENAL = "adrenal"
    TALUS = "talus"
    VERTEBRA = "vertebra"
    FEMUR = "femur"


def load_cohort(name: CohortName, root: Path, options: CohortOptions) -> Cohort:
    """A named cohort below a data folder, which holds one folder a cohort.

    Raises:
        CohortError: not there, or not fit to be used.
    """
    match name:
        case CohortName.HIPPOCAMPUS:
            return hippocampus.load(root, options)
        case CohortName.ADRENAL:
            return adrenal.load(root, options)
        case CohortName.TALUS:
            return talus.load(root, options)
        case CohortName.VERTEBRA:
            return vertebra.load(root, options)
        case CohortName.FEMUR:
            return femur.load(root, options)


def data_folder(named: Path | None) -> Path:
    """The data folder that was named, or that of the environment (`DATA_VARIABLE`).

    Raises:
        CohortError: none is named, or it is not there.
    """
    found = named or os.environ.get(DATA_VARIABLE)
    if not found:
        raise CohortError(
            f"Public cohorts are read from a data folder, and none is named; name one with --data or {DATA_VARIABLE}."
        )
    if not Path(found).is_dir():
        raise CohortError(f"The data folder does not exist; name one that does with --data or {DATA_VARIABLE}.")
    return Path(found)
