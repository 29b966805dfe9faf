"""What is asked of the solver and what it answers."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
from jaxtyping import Float

from model.geometry import Pose
from model.inference.discrepancy.process import Discrepancy

MirrorRule = Literal["auto", "never", "always"]


class FitStatus(StrEnum):
    """Why the solver stopped."""

    CONVERGED = "converged"
    STALLED = "stalled"
    ITERATION_LIMIT = "iteration_limit"

    @property
    def sentence(self) -> str:
        """The same as a sentence."""
        return _SENTENCES[self]


_SENTENCES = {
    FitStatus.CONVERGED: "The fit converged: the last step was below the tolerance.",
    FitStatus.STALLED: "The fit stopped because no damped step lowered the objective further.",
    FitStatus.ITERATION_LIMIT: "The fit reached its limit of iterations before it converged.",
}


@dataclass(frozen=True)
class FitOptions:
    """Settings of the solver.

    Attributes:
        mirror: whether left and right may be exchanged.
        screened: whether starts are looked for among many places of the mean shape; of drawings on one or two planes
            they always are.
        robust: whether planes that contradict all others are left out.
        position_sd_mm, rotation_sd, log_scale_sd: pose prior around the starting pose; rotation in rad.
        max_iterations: Levenberg-Marquardt iterations of one start.
        tolerance: converged when the predicted decrease of the objective is below it (nats); that step is still taken.
    """

    mirror: MirrorRule = "never"
    screened: bool = False
    robust: bool = True
    position_sd_mm: float = 20.0
    rotation_sd: float = 0.15
    log_scale_sd: float = 0.02
    max_iterations: int = 40
    tolerance: float = 0.25


#: By what a voxel of a thick slice is foreground: the object at the slice's centre, half of the thickness filled, or a
#: share of an even number of fine slices that the thick one was averaged from.
ThickRule = Literal["section", "half", "at least half", "more than half"]


@dataclass(frozen=True)
class Rival:
    """Another optimum that is nearly as probable and lies elsewhere.

    Attributes:
        nats: how much less probable it is.
        distance_mm: how far away the object lies, RMS over points within it.
    """

    nats: float
    distance_mm: float


@dataclass(frozen=True)
class Fit:
    """What the solver found.

    Attributes:
        latent: (d,) latent code at the optimum.
        pose: world to canonical.
        status: why it stopped; `message` is the same as a sentence.
        iterations: Levenberg-Marquardt iterations of the chosen start, all stages.
        objective: negative log posterior at the optimum (nats).
        precision: (d + 7, d + 7) curvature of the objective over (latent, pose step).
        plane_weights: (k,) trust in each annotated plane: 0 for one that contradicts the others and was left out of
            the fit, else 1; None when that was not looked into.
        doubted: number of a plane that stands out from the others, though too little to be left out, or None.
        rival: another optimum, of those that starts led to, that the drawing hardly tells from this one; None without.
        discrepancy: what the drawn contours show and the code cannot express; None when it was not asked for.
        trust: share of the model's likelihood precision that the drawing was given; below 1 for a rough one.
        full_trust_misfit_mm: how far the contours of a rough drawing lay from the fit that trusted it in full (RMS);
            None of any other.
        thick_rule: by what thick slices were drawn, as far as can be told.
        thick_doubt: (t, 3) how far the object's ends may lie elsewhere because it might have been another rule (SD,
            world mm) along the normal of each direction of thick slices; None without such slices.
    """

    latent: Float[np.ndarray, "d"]
    pose: Pose
    status: FitStatus
    message: str
    iterations: int
    objective: float
    precision: Float[np.ndarray, "p p"]
    plane_weights: Float[np.ndarray, "k"] | None = None
    doubted: int | None = None
    rival: Rival | None = None
    discrepancy: Discrepancy | None = None
    trust: float = 1.0
    full_trust_misfit_mm: float | None = None
    thick_rule: ThickRule = "half"
    thick_doubt: Float[np.ndarray, "t 3"] | None = None
