"""What a training run is made of; written beside its checkpoints and into the exported manifest."""

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from model.networks.decoder import DecoderShape
from model.networks.flow import FlowShape
from model.networks.prior import PriorShape

Regime = Literal["thin", "thick", "orthogonal", "dense"]
ObjectiveName = Literal["paper", "denoising", "centred", "variational"]
ReconstructionName = Literal["dice", "bce", "bce_dice"]


@dataclass(frozen=True)
class ObjectiveConfig:
    """Weights of the joint objective.

    Attributes:
        name: ``paper`` treats codes as points and adds the negative log prior density. The others keep that bounded:
            ``denoising`` blurs the points by a fixed noise; ``centred`` treats each code as a diagonal Gaussian and
            adds the Kullback-Leibler divergence to the prior; ``variational`` does so with the Gaussians in units of
            the prior's sigmas.
        reconstruction: loss over sampled points and labels.
        lambda_flow: weight of the density or divergence term against the mean loss over points.
        ramp: share of the steps over which `lambda_flow` and `lambda_ard` rise from 0: dimensions find a use first.
        lambda_ard: weight of the Gamma prior on the precisions.
        a, b: shape and rate of that Gamma prior; a > 1, b < 1.
        lambda_isometry: weight of `training.objective.unevenness`: how differently one step of the code moves the
            surfaces of different shapes. It rises from 0 between the shares `isometry_start` and `isometry_full` of the
            steps: shapes come first.
    """

    name: ObjectiveName = "variational"
    reconstruction: ReconstructionName = "bce"
    lambda_flow: float = 1e-3
    ramp: float = 0.3
    lambda_ard: float = 1e-4
    a: float = 2.0
    b: float = 1e-6
    lambda_isometry: float = 0.0
    isometry_start: float = 0.25
    isometry_full: float = 0.5


@dataclass(frozen=True)
class TrainingConfig:
    """One training run.

    Attributes:
        steps: optimiser steps; `batch_shapes` shapes a step, each with `near_points` points close to its contour and
            `far_points` elsewhere.
        learning_rate: of the networks; `code_learning_rate` of the latent codes. Both rise over `warm_up` (share of
            steps) and fall to zero along a cosine.
        reflected: whether each training shape is joined by its mirror image (left and right exchanged), which belongs
            to the population where sides are mixed or the structure is symmetric.
        patience: validations without a better figure after which the run ends with its best module; 0 never ends it.
        flow_start: share of steps after which the flow is trained; it is the identity before.
    """

    decoder: DecoderShape = field(default_factory=DecoderShape)
    prior: PriorShape = field(default_factory=lambda: PriorShape(FlowShape()))
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    regime: Regime = "dense"
    reflected: bool = False
    steps: int = 8000
    batch_shapes: int = 32
    near_points: int = 192
    far_points: int = 64
    learning_rate: float = 2e-3
    code_learning_rate: float = 1e-2
    flow_learning_rate: float = 3e-4
    weight_decay: float = 1e-4
    warm_up: float = 0.03
    flow_start: float = 0.3
    seed: int = 0
    device: str = "cpu"
    checkpoint_every: int = 500
    validate_every: int = 1000
    patience: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Nested plain values, for JSON."""
        return asdict(self)


def config_from_dict(values: dict[str, Any]) -> TrainingConfig:
    """Inverse of `TrainingConfig.as_dict`."""
    prior = dict(values["prior"])
    prior["flow"] = FlowShape(**prior["flow"])
    parts = {
        "decoder": DecoderShape(**values["decoder"]),
        "prior": PriorShape(**prior),
        "objective": ObjectiveConfig(**values["objective"]),
    }
    return TrainingConfig(**{**values, **parts})
