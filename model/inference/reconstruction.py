"""From mask stacks to a surface: the whole way in one function.

observations -> fit -> surface -> uncertainty. Reads no setting, no clock and no global.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.geometry import Grid
from model.inference.fitting import Fit, MirrorRule
from model.inference.mesh import Mesh
from model.inference.observations import AnnotatedRule, MaskStack, Plane

UncertaintyRule = Literal["laplace", "ensemble", "none"]
#: Called with the name of each stage as it begins: observations, fit, surface, uncertainty.
Watch = Callable[[str], None]


@dataclass(frozen=True)
class Options:
    """What a caller may choose; names and meanings are those of the REST interface.

    Attributes:
        annotated: which planes were looked at.
        uncertainty: how uncertainty is found.
        mirror: whether left and right may be exchanged.
        resolution_mm: grid step of the surface; the model's own when None.
        seed: makes the answer repeatable.
    """

    annotated: AnnotatedRule | tuple[Plane, ...] = "auto"
    uncertainty: UncertaintyRule = "laplace"
    mirror: MirrorRule = "never"
    resolution_mm: float | None = None
    seed: int = 0


@dataclass(frozen=True)
class Estimate:
    """A figure with its 90 % interval; `low` and `high` are None when uncertainty was not asked for."""

    value: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class PlaneResidual:
    """How far one drawn plane and the reconstruction's section disagree.

    Attributes:
        plane: which plane.
        disagreement: share of the observations' weight on the wrong side of the surface, 0 to 1.
        mean_error: mean signed occupancy residual (label minus probability).
    """

    plane: Plane
    disagreement: float
    mean_error: float


@dataclass(frozen=True)
class ShapeState:
    """What is needed to evaluate the reconstructed field anywhere: one or more weighted members.

    Attributes:
        fits: the fit (Laplace, none) or the ensemble's members.
        covariance: (p, p) posterior covariance over (latent, pose step) of the first fit, or None.
    """

    fits: tuple[Fit, ...]
    covariance: Float[np.ndarray, "p p"] | None


@dataclass(frozen=True)
class Reconstruction:
    """The answer, in world RAS mm.

    Attributes:
        state: evaluates the field; `occupancy` takes it.
        mesh: watertight surface; with uncertainty its scalar ``surface_sd_mm`` is there.
        planes: planes that were used.
        observation_count: number of point observations.
        residuals: disagreement of each plane.
        volume_ml, area_cm2: figures with 90 % intervals.
        log_prior_density: nats.
        typicality_percentile: share of the training population with a lower density, 0 to 100.
        warnings: plain sentences, for example that the shape is unlike the training population.
    """

    state: ShapeState
    mesh: Mesh
    planes: tuple[Plane, ...]
    observation_count: int
    residuals: tuple[PlaneResidual, ...]
    volume_ml: Estimate
    area_cm2: Estimate
    log_prior_density: float
    typicality_percentile: float
    warnings: tuple[str, ...]


def reconstruct(
    model: ShapeModel, stacks: Sequence[MaskStack], options: Options, watch: Watch = lambda stage: None
) -> Reconstruction:
    """Fit the model to the stacks and extract surface and uncertainty.

    Raises:
        InvalidMask: no foreground, or everything in one plane.
        InconsistentStacks: the stacks cannot be of one object.
        InvalidParameter: an option out of its range.
    """
    raise NotImplementedError


def occupancy(model: ShapeModel, state: ShapeState, grid: Grid) -> Float[np.ndarray, "i j k"]:
    """Posterior mean occupancy probability at the voxel centres of a grid."""
    raise NotImplementedError


def covering_grid(mesh: Mesh, spacing_mm: float, margin_mm: float = 5.0) -> Grid:
    """Axis-aligned RAS grid around a mesh."""
    raise NotImplementedError


def voxel_entropy(probability: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """Entropy of a Bernoulli variable (nats), 0 to ln 2."""
    raise NotImplementedError
