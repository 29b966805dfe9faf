"""Maximum a posteriori fit of latent code and pose to observations, by damped Gauss-Newton.

The objective is the negative log posterior

    E(z, pose) = lambda * sum_n w_n BCE(logit_n, y_n) + 1/2 |z0(z) / sigma|^2 - log p(pose)

over observations with weights ``w_n`` (mm^2 of annotated plane) and likelihood precision ``lambda`` (1/mm^2;
neighbouring voxels are not independent, so it is calibrated on validation shapes). Each evaluation gives logits with
their Jacobians by latent code and point; the pose's follow by the chain rule. The prior's mode is taken in the flow's
base coordinates ``z0 = g(z)``, where it is Gaussian: that makes it a sum of squares with Jacobian ``dz0/dz``, and the
whole a Gauss-Newton problem with curvature ``lambda w p (1 - p) J J^T`` plus ``(dz0/dz)^T diag(1/sigma^2) dz0/dz``
(Levenberg 1944, Marquardt 1963). The density's own mode in ``z`` would follow every ripple of the splines' determinant.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag, cho_factor, cho_solve
from scipy.spatial.transform import Rotation
from scipy.special import expit

from model.bundle import ShapeModel
from model.errors import InvalidMask
from model.geometry import POSE_SIZE, Pose
from model.inference.observations import Observations

MirrorRule = Literal["auto", "never", "always"]

#: Up to this damping a step is close to the Gauss-Newton step.
FREE_DAMPING = 1.0
#: Longest step of one iteration: of the code (prior SDs), of the position (mm) and of the rotation (rad).
LONGEST_CODE_STEP, LONGEST_MOVE_MM, LONGEST_TURN = 4.0, 15.0, 0.35


class FitStatus(StrEnum):
    """Why the solver stopped."""

    CONVERGED = "converged"
    STALLED = "stalled"
    ITERATION_LIMIT = "iteration_limit"


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
        position_sd_mm, rotation_sd, log_scale_sd: pose prior around the starting pose; rotation in rad.
        max_iterations: Levenberg-Marquardt iterations of one start.
        tolerance: converged when the predicted decrease of the objective is below it (nats).
    """

    mirror: MirrorRule = "never"
    position_sd_mm: float = 20.0
    rotation_sd: float = 0.15
    log_scale_sd: float = 0.02
    max_iterations: int = 40
    tolerance: float = 1e-2


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


@dataclass(frozen=True)
class _Point:
    """The objective at one place, its gradient and Fisher curvature over (latent, pose step), and the prior's SDs."""

    latent: Float[np.ndarray, "d"]
    pose: Pose
    value: float
    gradient: Float[np.ndarray, "p"]
    curvature: Float[np.ndarray, "p p"]
    reach: Float[np.ndarray, "d"]


class _Objective:
    """The negative log posterior of one model, one set of observations and one starting pose."""

    def __init__(self, model: ShapeModel, observations: Observations, start: Pose, options: FitOptions) -> None:
        self._model = model
        self._points = observations.points
        self._labels = observations.labels
        self._weights = model.manifest.likelihood_precision * observations.weights
        self._start = start
        self._pose_precision = 1.0 / np.square(
            [options.position_sd_mm] * 3 + [options.rotation_sd] * 3 + [options.log_scale_sd]
        )
        self._sigmas = np.asarray(model.manifest.sigmas)

    def at(self, latent: Float[np.ndarray, "d"], pose: Pose, sharpness: float = 1.0) -> _Point:
        """Evaluate; logits are multiplied by `sharpness` (below 1 widens the basin of attraction)."""
        canonical = pose.to_canonical(self._points)
        logits, by_latent, by_point = (
            part[0] for part in self._model.decoder.logits_and_jacobians(latent[None], canonical[None])
        )
        jacobian = sharpness * np.concatenate([by_latent, pose.jacobian(canonical, by_point)], axis=1)
        scaled = sharpness * logits.astype(float)
        probability = expit(scaled)
        cross_entropy = np.logaddexp(0.0, scaled) - self._labels * scaled
        fisher = self._weights * probability * (1.0 - probability)
        point = _Point(
            latent,
            pose,
            float(self._weights @ cross_entropy),
            (self._weights * (probability - self._labels)) @ jacobian,
            (jacobian * fisher[:, None]).T @ jacobian,
            self._sigmas,
        )
        return self._with_priors(point)

    def _with_priors(self, point: _Point) -> _Point:
        base, by_latent = (part[0].astype(float) for part in self._model.prior.base_jacobian(point.latent[None]))
        whitened, slope = base / self._sigmas, by_latent / self._sigmas[:, None]
        offset = pose_offset(self._start, point.pose)
        pull = self._pose_precision * offset
        gradient = point.gradient + np.concatenate([slope.T @ whitened, pull])
        curvature = point.curvature + block_diag(slope.T @ slope, np.diag(self._pose_precision))
        value = point.value + 0.5 * float(whitened @ whitened) + 0.5 * float(pull @ offset)
        return replace(point, value=value, gradient=gradient, curvature=curvature)


def pose_offset(start: Pose, pose: Pose) -> Float[np.ndarray, "7"]:
    """The step that takes one pose to another (position mm, rotation vector rad, log scale)."""
    turn = Rotation.from_matrix(pose.rotation @ start.rotation.T).as_rotvec()
    return np.concatenate([pose.position - start.position, turn, [pose.log_scale - start.log_scale]])


def fit(model: ShapeModel, observations: Observations, options: FitOptions) -> Fit:
    """The best of the fits from every starting pose that the options allow."""
    fits = [fit_from(model, observations, start, options) for start in starting_poses(observations, options)]
    return min(fits, key=lambda found: found.objective)


def starting_poses(observations: Observations, options: FitOptions) -> Sequence[Pose]:
    """Poses at the centroid of the drawn foreground, one for each side that may be tried.

    Raises:
        InvalidMask: no observation is foreground, as when thinning out many planes left none that holds any.
    """
    inside = observations.weights * observations.labels
    if not inside.any():
        raise InvalidMask(
            "mask holds no foreground on the planes that were sampled from it; fewer annotated planes are accepted",
            part="mask",
        )
    centre = inside @ observations.points / inside.sum()
    sides = {"never": (False,), "always": (True,), "auto": (False, True)}[options.mirror]
    return [Pose(position=centre, mirrored=side) for side in sides]


def fit_from(
    model: ShapeModel,
    observations: Observations,
    start: Pose,
    options: FitOptions,
    latent: Float[np.ndarray, "d"] | None = None,
) -> Fit:
    """Fit from one starting pose, and one starting code (the centre of the latent space when None)."""
    objective = _Objective(model, observations, start, options)
    code = np.zeros(model.manifest.latent_size) if latent is None else latent
    point, count, _ = _descend(objective, code, start, 0.3, replace(options, tolerance=1.0, max_iterations=8))
    point, more, status = _descend(objective, point.latent, point.pose, 1.0, options)
    return Fit(point.latent, point.pose, status, _SENTENCES[status], count + more, point.value, point.curvature)


def _descend(
    objective: _Objective, latent: Float[np.ndarray, "d"], pose: Pose, sharpness: float, options: FitOptions
) -> tuple[_Point, int, FitStatus]:
    """Levenberg-Marquardt with Nielsen's damping update."""
    point = objective.at(latent, pose, sharpness)
    damping, growth = 1e-2, 2.0
    for iteration in range(options.max_iterations):
        step = _damped_step(point, damping)
        expected = -float(step @ point.gradient + 0.5 * step @ point.curvature @ step)
        if expected < options.tolerance:
            # Behind rejected steps a step is short by its damping, not because the optimum is near.
            return point, iteration, FitStatus.CONVERGED if damping <= FREE_DAMPING else FitStatus.STALLED
        trial = objective.at(point.latent + step[:-POSE_SIZE], point.pose.moved(step[-POSE_SIZE:]), sharpness)
        gain = (point.value - trial.value) / expected
        if gain > 0:
            point = trial
            damping *= max(1.0 / 5.0, 1.0 - (2.0 * gain - 1.0) ** 3)
            growth = 2.0
        else:
            damping *= growth
            growth *= 2.0
        if damping > 1e8:
            return point, iteration + 1, FitStatus.STALLED
    return point, options.max_iterations, FitStatus.ITERATION_LIMIT


def _damped_step(point: _Point, damping: float) -> Float[np.ndarray, "p"]:
    """Solution of the damped normal equations, shortened so that the object moves and turns by a bounded step."""
    damped = point.curvature + damping * np.diag(np.diag(point.curvature))
    step = -cho_solve(cho_factor(damped), point.gradient)
    excess = max(
        np.linalg.norm(step[:-POSE_SIZE] / point.reach) / LONGEST_CODE_STEP,
        np.linalg.norm(step[-POSE_SIZE:-4]) / LONGEST_MOVE_MM,
        np.linalg.norm(step[-4:-1]) / LONGEST_TURN,
    )
    return np.asarray(step / max(1.0, excess))
