"""What to expect of few or small shapes: sentences for the caller, before the work begins."""

import numpy as np

from model.errors import InvalidParameter
from training.cohorts.cohort import Cohort
from training.cohorts.inspect import extent_mm

#: Training shapes below which a model cannot be made, and those below which it has seen little.
LEAST_SHAPES, FEW_SHAPES = 2, 10
#: Validation shapes below which calibration is left to chance.
FEW_VALIDATION = 4
#: Training shapes below which a completion network mostly learns them by heart.
FEW_COMPLETED = 50
#: Training shapes shorter than this are small beside the distances of the method (mm).
SMALL_MM = 15.0


def of_training(cohort: Cohort) -> str:
    """A warning, or nothing.

    Raises:
        InvalidParameter: fewer than `LEAST_SHAPES` training shapes.
    """
    count = len(cohort.train)
    if count < LEAST_SHAPES:
        raise InvalidParameter(
            f"{count} training shape(s) cannot tell how shapes differ; 3 and more, one of which is held out, are "
            "accepted.",
            part="cohort",
        )
    return "; ".join(words for words in (_few(count), _small(cohort)) if words)


def _few(count: int) -> str:
    if count >= FEW_SHAPES:
        return ""
    return (
        f"{count} training shapes are few: reconstructions of other shapes will look like these; twenty are enough to "
        "begin with"
    )


def _small(cohort: Cohort) -> str:
    length = float(np.median([extent_mm(case.mask, case.grid) for case in cohort.train]))
    if length >= SMALL_MM:
        return ""
    return (
        f"shapes of {length:.3g} mm are small: the method's distances, which are in mm, suit objects from about 20 mm; "
        "masks with a spacing scaled up by one factor for all come out better"
    )


def of_calibration(cohort: Cohort) -> str:
    """A warning, or nothing."""
    count = len(cohort.validation)
    if count >= FEW_VALIDATION:
        return ""
    return f"{count} validation shape(s) are few: what is chosen, and how wide SDs are made, is partly chance"


def of_completion(cohort: Cohort) -> str:
    """A warning, or nothing."""
    count = len(cohort.train)
    if count >= FEW_COMPLETED:
        return ""
    return (
        f"{count} training shapes are few for a network that fills in drawings; it is meant for some hundred and more"
    )
