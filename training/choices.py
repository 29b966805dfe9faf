"""What a caller of the training commands may choose, and the configuration that follows from it."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING

from model.errors import InvalidParameter

if TYPE_CHECKING:
    from training.config import TrainingConfig

#: One shape in so many is drawn in a step, within a range.
BATCH_SHARE, BATCH_RANGE = 4, (32, 128)
#: Points of a step, and at most of a shape; three quarters of them near its contour.
STEP_POINTS, MOST_POINTS = 8192, 256
#: Principal movements below this share of the largest are left out unless a caller says otherwise.
LEAST_MOVEMENT = 0.01
#: What the prior of the training keeps of the covariance unless a caller says otherwise. Codes that were left out would
#: be more probable with less of it, but most shapes are reconstructed from few slices better with more.
LEAST_OF_TRAINING = 0.5
#: Validations of a run with early stopping.
VALIDATIONS = 20


class RegimeName(StrEnum):
    """How sparse the drawings are."""

    THIN = "thin"
    THICK = "thick"
    ORTHOGONAL = "orthogonal"
    DENSE = "dense"


class SplitName(StrEnum):
    """Which held-out cases are measured."""

    VALIDATION = "validation"
    TEST = "test"


#: What to do where a split has no cases.
OTHER_SPLIT = {
    SplitName.TEST: "train with --test-fraction and say the same here, or measure with --split validation",
    SplitName.VALIDATION: "measure with --split test, or train on a larger cohort",
}


class ObjectiveName(StrEnum):
    """Which objective is minimised."""

    PAPER = "paper"
    DENOISING = "denoising"
    CENTRED = "centred"
    VARIATIONAL = "variational"


class DeviceName(StrEnum):
    """Where training runs."""

    CPU = "cpu"
    CUDA = "cuda"
    AUTO = "auto"


@dataclass(frozen=True)
class TrainingChoice:
    """What a caller chooses of a training; what is None follows from the rest.

    Attributes:
        flow, ard: whether they are trained along with the decoder; unless the objective is ``variational``, when None:
            codes that are Gaussians get both when training is over (`training.pruning`).
        ard_weight: of ARD; its default when None.
        isometry: weight of movements that are the same for all shapes; 0 leaves them as they come.
        reflect: whether mirror images join; those of a cohort without sides, when None, but not in the paper's
            objective.
        steps, epochs: how long it is; the steps of the default configuration when both are None.
        patience: see `with_patience`.

    Raises:
        InvalidParameter: two choices exclude each other, or one would do nothing.
    """

    objective: ObjectiveName
    regime: RegimeName
    latent_size: int
    flow: bool | None = None
    ard: bool | None = None
    ard_weight: float | None = None
    isometry: float = 0.0
    reflect: bool | None = None
    steps: int | None = None
    epochs: int | None = None
    patience: int = 0
    seed: int = 0
    device: DeviceName = DeviceName.AUTO

    def __post_init__(self) -> None:
        if self.steps is not None and self.epochs is not None:
            raise InvalidParameter("Steps and epochs exclude each other; one of them is accepted.", part="epochs")
        if self.ard_weight is not None and not self.use_ard:
            raise InvalidParameter(
                "ARD does not act along, so that --ard-weight would do nothing; it is accepted with --ard.",
                part="ard_weight",
            )

    @property
    def use_flow(self) -> bool:
        """Whether a flow is trained along."""
        return self._is_joint if self.flow is None else self.flow

    @property
    def use_ard(self) -> bool:
        """Whether ARD acts along."""
        return self._is_joint if self.ard is None else self.ard

    @property
    def _is_joint(self) -> bool:
        return self.objective is not ObjectiveName.VARIATIONAL


def configured(choice: TrainingChoice, *, reflected: bool) -> "TrainingConfig":
    """The configuration that a choice describes, whatever the cohort's size.

    ``paper`` is the MorphoFlow paper as written: points as codes, soft Dice, a plain decoder, the flow on the codes
    themselves, batches of 6.

    Args:
        reflected: whether mirror images join.

    Raises:
        InvalidParameter: the device is not there.
    """
    from model.networks.decoder import DecoderShape
    from model.networks.flow import FlowShape
    from model.networks.prior import PriorShape
    from training.config import ObjectiveConfig, TrainingConfig

    paper, plain = choice.objective is ObjectiveName.PAPER, TrainingConfig()
    prior = replace(
        PriorShape(FlowShape(latent_size=choice.latent_size)),
        use_flow=choice.use_flow,
        use_ard=choice.use_ard,
        standardise=not paper,
    )
    loss = (
        ObjectiveConfig(name="paper", reconstruction="dice", ramp=0.0)
        if paper
        else replace(plain.objective, name=choice.objective.value)
    )
    if choice.ard_weight is not None:
        loss = replace(loss, lambda_ard=choice.ard_weight)
    loss = replace(loss, lambda_isometry=choice.isometry)
    return replace(
        plain,
        decoder=DecoderShape(latent_size=choice.latent_size, unit_columns=not paper),
        prior=prior,
        objective=loss,
        regime=choice.regime.value,
        batch_shapes=6 if paper else plain.batch_shapes,
        reflected=reflected,
        seed=choice.seed,
        device=resolved(choice.device),
    )


def resolved(device: DeviceName) -> str:
    """``cpu`` or ``cuda``.

    Raises:
        InvalidParameter: CUDA was asked for and is not there.
    """
    import torch

    there = torch.cuda.is_available()
    if device is DeviceName.CUDA and not there:
        raise InvalidParameter("No CUDA device is there; cpu or auto is accepted.", part="device")
    return "cuda" if there and device is not DeviceName.CPU else "cpu"


def with_batches(config: "TrainingConfig", shapes: int) -> "TrainingConfig":
    """The configuration with batches for a cohort of so many codes; the paper's are left as they are.

    A code learns only when its shape is drawn, so that large cohorts want many shapes a step and fewer points of each.
    """
    if config.objective.name == "paper":
        return config
    batch = min(max(shapes // BATCH_SHARE, BATCH_RANGE[0]), BATCH_RANGE[1])
    points = min(MOST_POINTS, STEP_POINTS // batch)
    return replace(config, batch_shapes=batch, near_points=3 * points // 4, far_points=points // 4)


def with_duration(config: "TrainingConfig", steps: int | None, epochs: int | None, shapes: int) -> "TrainingConfig":
    """The configuration with its number of steps: that of so many epochs, where they are given."""
    if epochs is not None:
        steps = epochs * -(-shapes // min(config.batch_shapes, shapes))
    return config if steps is None else replace(config, steps=steps)


def with_patience(config: "TrainingConfig", patience: int) -> "TrainingConfig":
    """The configuration with early stopping: twenty validations a run, and an end after ``patience`` without gain."""
    if patience == 0:
        return config
    every = max(1, config.steps // VALIDATIONS)
    return replace(config, patience=patience, validate_every=every)


def anatomy_code(words: str | None) -> dict[str, str]:
    """A SNOMED CT code and its meaning as they stand in a manifest.

    Raises:
        InvalidParameter: no code of 6 to 18 digits followed by its meaning.
    """
    if words is None:
        return {}
    value, _, meaning = words.strip().partition(" ")
    if not (value.isdecimal() and 6 <= len(value) <= 18 and meaning.strip()):
        raise InvalidParameter("A SNOMED CT code and its meaning are accepted, as '67453005 Talus'.", part="anatomy")
    return {"value": value, "scheme": "SCT", "meaning": meaning.strip()}
