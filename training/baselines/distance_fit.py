"""Fitting the modes of signed-distance fields to drawn slices.

Maximum a posteriori of coefficients and rigid pose: the label of a drawn point is Bernoulli with the logistic function
of the field over a width, coefficients are standard normal, the pose has the SDs of the project's own fit.
Levenberg-Marquardt with Fisher's curvature, from wide to narrow logistic functions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation
from scipy.special import expit

from model.geometry import Grid, Pose
from model.inference.observations import MaskStack, Observations, Plane, observe
from training.baselines.distance_modes import DistanceModes, sampled

#: Point observations, as many as the project's own fit uses.
BUDGET = 2500
#: Prior standard deviations of position (mm) and rotation (rad).
POSE_SDS = np.array([20.0, 20.0, 20.0, 0.15, 0.15, 0.15])
#: Widths of the logistic function come down to the chosen one by these factors, with so many iterations each.
WIDTH_FACTORS, ITERATIONS = (2.0, 1.0), (8, 30)
#: A stage ends when the objective falls by less than this share of itself.
LEAST_PROGRESS = 1e-5
FIRST_DAMPING, DAMPING_DOWN, DAMPING_UP, MOST_DAMPING = 1e-2, 0.3, 5.0, 1e6


@dataclass(frozen=True)
class FitSettings:
    """What is chosen on validation shapes.

    Attributes:
        share: of the variance that the modes in use explain.
        precision: what a drawn mm^2 is worth (1/mm^2).
        width_mm: of the logistic function.
    """

    share: float = 0.98
    precision: float = 0.2
    width_mm: float = 0.5


@dataclass(frozen=True)
class ModeFit:
    """Coefficients (k,), the pose from the world to the canonical frame, and iterations taken."""

    coefficients: Float[np.ndarray, "k"]
    pose: Pose
    iterations: int


@dataclass(frozen=True)
class _Linearised:
    """Objective (nats) at a point, its gradient and its curvature over coefficients and pose."""

    value: float
    gradient: Float[np.ndarray, "p"]
    curvature: Float[np.ndarray, "p p"]


def fit_modes(
    modes: DistanceModes, stacks: Sequence[MaskStack], planes: Sequence[Plane], settings: FitSettings
) -> ModeFit:
    """Fit to the annotated planes of some stacks; starts at the mean shape on the drawn foreground's centroid.

    Args:
        modes: already reduced to those in use.

    Raises:
        InvalidMask: nothing was looked at on the planes.
    """
    seen = observe(stacks, planes, budget=BUDGET, seed=0)
    weight = seen.labels * seen.weights
    home = weight @ seen.points / weight.sum()
    found = ModeFit(np.zeros(modes.modes.shape[1]), Pose(home), 0)
    for factor, iterations in zip(WIDTH_FACTORS, ITERATIONS, strict=True):
        wide = replace(settings, width_mm=factor * settings.width_mm)
        found = _descend(partial(_linearise, modes, _columns(modes), seen, wide, home), found, iterations)
    return found


def filled(modes: DistanceModes, found: ModeFit, target: Grid) -> Bool[np.ndarray, "i j k"]:
    """Voxels of a grid whose centre lies inside the fitted shape."""
    field = modes.field(found.coefficients).reshape(modes.grid.shape)
    index = modes.grid.to_index(found.pose.to_canonical(target.centres()))
    value = map_coordinates(field, index.T, order=1, mode="constant", cval=-modes.clip_mm)
    return np.asarray(value.reshape(target.shape) > 0)


def _descend(objective: Callable[[ModeFit], _Linearised], start: ModeFit, iterations: int) -> ModeFit:
    """Levenberg-Marquardt at one width."""
    here, damping = start, FIRST_DAMPING
    at = objective(here)
    for _ in range(iterations):
        step = np.linalg.solve(at.curvature + damping * np.diag(np.diag(at.curvature)), -at.gradient)
        trial = _moved(here, step)
        there = objective(trial)
        if there.value >= at.value:
            here, damping = replace(here, iterations=here.iterations + 1), damping * DAMPING_UP
            if damping > MOST_DAMPING:
                break
            continue
        done = at.value - there.value < LEAST_PROGRESS * at.value
        here, at, damping = trial, there, damping * DAMPING_DOWN
        if done:
            break
    return here


def _columns(modes: DistanceModes) -> Float[np.ndarray, "v k1"]:
    """The modes, and the mean as the last column."""
    return np.concatenate([modes.modes, modes.mean[:, None]], axis=1)


def _moved(found: ModeFit, step: Float[np.ndarray, "p"]) -> ModeFit:
    count = len(found.coefficients)
    pose = found.pose.moved(np.append(step[count:], 0.0))
    return ModeFit(found.coefficients + step[:count], pose, found.iterations + 1)


def _linearise(
    modes: DistanceModes,
    values: Float[np.ndarray, "v k1"],
    seen: Observations,
    settings: FitSettings,
    home: Float[np.ndarray, "3"],
    found: ModeFit,
) -> _Linearised:
    """Objective, gradient and Fisher curvature; ``values`` as `_columns` gives them, ``home`` the pose's prior mean."""
    points = found.pose.to_canonical(seen.points)
    combined = np.append(found.coefficients, 1.0)
    at, slope = sampled(values, combined, modes.grid, points)
    logits = (at @ combined) / settings.width_mm
    by_pose = found.pose.jacobian(points, slope)[:, :6]
    jacobian = np.concatenate([at[:, :-1], by_pose], axis=1) / settings.width_mm
    weights = settings.precision * seen.weights
    probability = expit(logits)
    apart = np.concatenate([found.coefficients, found.pose.position - home, _rotation_vector(found.pose)])
    prior = np.concatenate([np.ones(len(found.coefficients)), POSE_SDS**-2.0])
    loss = weights @ (np.logaddexp(0.0, logits) - seen.labels * logits)
    gradient = jacobian.T @ (weights * (probability - seen.labels)) + prior * apart
    curvature = (jacobian.T * (weights * probability * (1.0 - probability))) @ jacobian + np.diag(prior)
    return _Linearised(float(loss + 0.5 * prior @ apart**2), gradient, curvature)


def _rotation_vector(pose: Pose) -> Float[np.ndarray, "3"]:
    return np.asarray(Rotation.from_matrix(pose.rotation).as_rotvec())
