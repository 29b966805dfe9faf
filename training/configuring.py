"""The configuration of a training on a cohort: of `morphoflow train`, and of each cell of a sweep."""

from model.errors import InvalidParameter
from training.choices import ObjectiveName, TrainingChoice, configured, with_batches, with_duration, with_patience
from training.cohorts.cohort import Cohort
from training.config import TrainingConfig


def configured_for(cohort: Cohort, choice: TrainingChoice) -> TrainingConfig:
    """The configuration that a choice describes, with batches and steps for the size of the cohort.

    Raises:
        InvalidParameter: the device is not there.
    """
    by_cohort = cohort.reflects and choice.objective is not ObjectiveName.PAPER
    paired = by_cohort if choice.reflect is None else choice.reflect
    codes = (2 if paired else 1) * len(cohort.train)
    config = with_batches(configured(choice, reflected=paired), codes)
    return with_patience(with_duration(config, choice.steps, choice.epochs, codes), choice.patience)


def check_patience(cohort: Cohort, patience: int | None) -> None:
    """Refuse patience that was asked for and could not act.

    Args:
        patience: as a caller gave it; None where it was left out.

    Raises:
        InvalidParameter: validations are to end a training, and the cohort has no shapes for them.
    """
    if patience and not cohort.validation:
        raise InvalidParameter(
            "The cohort has no validation cases by which a training could end early; a larger one, or no --patience, "
            "is accepted.",
            part="patience",
        )
