"""The configuration of a training on a cohort: of `morphoflow train`, and of each cell of a sweep."""

from model.errors import InvalidParameter
from training.choices import (
    DeviceName,
    ObjectiveName,
    RegimeName,
    configured,
    with_batches,
    with_duration,
    with_patience,
)
from training.cohorts.cohort import Cohort
from training.config import TrainingConfig


def configured_for(
    cohort: Cohort,
    objective: ObjectiveName,
    regime: RegimeName,
    latent_size: int,
    *,
    reflect: bool | None,
    flow: bool | None,
    ard: bool | None,
    ard_weight: float | None = None,
    steps: int | None,
    epochs: int | None = None,
    patience: int,
    seed: int,
    device: DeviceName,
) -> TrainingConfig:
    """The configuration that the options describe, with batches and steps for the size of the cohort.

    Args:
        reflect: whether mirror images join; those of a cohort without sides, when None, but not in the paper's
            objective.
        flow, ard, ard_weight: see `training.choices.configured`.
        steps, epochs: see `training.choices.with_duration`.
        patience: see `training.choices.with_patience`.

    Raises:
        InvalidParameter: steps and epochs were both given, or the device is not there.
    """
    paired = (cohort.reflects and objective is not ObjectiveName.PAPER) if reflect is None else reflect
    config = configured(
        objective,
        regime,
        latent_size,
        flow=flow,
        ard=ard,
        reflected=paired,
        seed=seed,
        device=device,
        ard_weight=ard_weight,
    )
    codes = (2 if paired else 1) * len(cohort.train)
    return with_patience(with_duration(with_batches(config, codes), steps, epochs, codes), patience)


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
