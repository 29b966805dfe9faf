"""Maximum a posteriori fit of latent code and pose to observations."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
from jaxtyping import Float

from model.geometry import Pose

MirrorRule = Literal["auto", "never", "always"]


class FitStatus(StrEnum):
    """Why the solver stopped."""

    CONVERGED = "converged"
    STALLED = "stalled"
    ITERATION_LIMIT = "iteration_limit"


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
    """

    latent: Float[np.ndarray, "d"]
    pose: Pose
    status: FitStatus
    message: str
    iterations: int
    objective: float
    precision: Float[np.ndarray, "p p"]
