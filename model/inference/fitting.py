"""Maximum a posteriori fit of latent code and pose to observations, by damped Gauss-Newton.

From every start the fit goes coarse to fine: first few observations and blunt logits, which widens the basin of
attraction, then all of them. Starts that fall behind are given up on the way. A plane that contradicts all others is
then left out (`model.inference.leave_out`). The objective is that of `model.inference.objective`.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from model.bundle import ShapeModel
from model.geometry import Pose
from model.inference.descent import Descent, Referee, descend
from model.inference.fit_types import Fit, FitOptions, FitStatus, MirrorRule
from model.inference.leave_out import contradicting_plane, most_wrong
from model.inference.objective import Objective, Place, pose_offset, reweighted
from model.inference.observations import Observations, thinned
from model.inference.rivals import rival_of
from model.inference.starts import Start, starting_poses, starts_of

__all__ = [
    "Fit",
    "FitOptions",
    "FitStatus",
    "MirrorRule",
    "fit",
    "fit_from",
    "fit_of",
    "pose_offset",
    "refit",
    "searched",
]

#: Logits of the coarse stage are multiplied by this.
COARSE_SHARPNESS = 0.3
#: The coarse stage uses one observation of so many, but not fewer than these altogether.
COARSE_EVERY, COARSE_FEWEST = 4, 300
#: The coarse stage ends at this predicted decrease (nats) or after so many iterations.
COARSE_TOLERANCE, COARSE_ITERATIONS = 1.0, 8
#: A start is given up when after so many coarse iterations, or at their end, its objective exceeds the best one's by
#: more than this many nats and this share of it.
TRIAL_ITERATIONS, BEHIND_NATS, BEHIND_SHARE = 3, 10.0, (1.0, 0.25)


def fit(model: ShapeModel, observations: Observations, options: FitOptions) -> Fit:
    """The best of the fits from every starting pose that the options allow, less planes that contradict the others."""
    starts = starts_of(model, observations, options, COARSE_SHARPNESS)
    found = fit_from(model, observations, starts, options)
    return _without_wrong_planes(model, observations, found, options) if options.robust else found


def searched(model: ShapeModel, observations: Observations, found: Fit, options: FitOptions) -> Fit:
    """The fit less planes that contradict the others, each of which is tried: for a fit that misses the contours.

    Unchanged where planes were left out before.
    """
    if not options.robust or (found.plane_weights is not None and not found.plane_weights.all()):
        return found
    return _without_wrong_planes(model, observations, found, options, every_plane=True)


def _without_wrong_planes(
    model: ShapeModel, observations: Observations, found: Fit, options: FitOptions, every_plane: bool = False
) -> Fit:
    """Leave out, one by one, planes that contradict all others, and fit anew to the rest."""
    trust = np.ones(len(observations.planes))
    trusted, doubted = observations, None
    for _ in range(most_wrong(observations)):
        start = starting_poses(trusted, options)[0]
        verdict = contradicting_plane(model, trusted, found, start, options, every_plane)
        if verdict is None or not verdict.blamed:
            doubted = None if verdict is None else verdict.plane
            break
        trust[verdict.plane] = 0.0
        trusted = reweighted(observations, trust)
        poses = starting_poses(trusted, options)
        anew = fit_from(model, trusted, [Start(pose, pose) for pose in poses], options)
        on = _from_place(model, trusted, found, poses[0], options)
        found = min(anew, on, key=lambda one: one.objective)
    return replace(found, plane_weights=trust, doubted=doubted)


def _from_place(model: ShapeModel, observations: Observations, found: Fit, start: Pose, options: FitOptions) -> Fit:
    """Go on from another fit, with the pose's prior around a start."""
    objective = Objective(model, observations, replace(start, mirrored=found.pose.mirrored), options)
    return fit_of(descend([objective], [Place(found.latent, found.pose)], 1.0, options)[0], found.iterations)


def refit(model: ShapeModel, observations: Observations, found: Fit, options: FitOptions) -> Fit:
    """Go on from a fit after its observations were moved; planes that it left out stay out."""
    if found.plane_weights is not None:
        observations = reweighted(observations, found.plane_weights)
    anew = _from_place(model, observations, found, starting_poses(observations, options)[0], options)
    return replace(
        anew,
        plane_weights=found.plane_weights,
        doubted=found.doubted,
        rival=found.rival,
        thick_rule=found.thick_rule,
    )


def fit_from(model: ShapeModel, observations: Observations, starts: Sequence[Start], options: FitOptions) -> Fit:
    """The best of the fits from several starts; those that fall behind early are not finished."""
    coarse = _coarse(model, observations, starts, options, _give_up_those_behind)
    last = _limit(coarse, BEHIND_SHARE[1])
    rest = [number for number, one in enumerate(coarse) if one.point.value <= last]
    fine = descend(
        [Objective(model, observations, starts[number].around, options) for number in rest],
        [_place(coarse[number]) for number in rest],
        1.0,
        options,
    )
    best = min(range(len(rest)), key=lambda place: fine[place].point.value)
    rival = rival_of(fine[best].point, [one.point for one in fine], np.asarray(model.manifest.half_extent_mm))
    return replace(fit_of(fine[best], coarse[rest[best]].iterations), rival=rival)


def _coarse(
    model: ShapeModel,
    observations: Observations,
    starts: Sequence[Start],
    options: FitOptions,
    referee: Referee,
) -> list[Descent]:
    """The first stage, from all starts side by side: blunt logits on few observations."""
    rough = thinned(observations, _coarse_step(len(observations.points)), seed=0)
    code = np.zeros(model.manifest.latent_size)
    return descend(
        [Objective(model, rough, start.around, options) for start in starts],
        [Place(code, start.pose) for start in starts],
        COARSE_SHARPNESS,
        replace(options, tolerance=COARSE_TOLERANCE, max_iterations=COARSE_ITERATIONS),
        referee,
    )


def _coarse_step(count: int) -> int:
    return max(1, min(COARSE_EVERY, count // COARSE_FEWEST))


def _give_up_those_behind(problems: Sequence[Descent]) -> None:
    limit = _limit(problems, BEHIND_SHARE[0])
    for problem in problems:
        if problem.status is None and problem.iterations >= TRIAL_ITERATIONS and problem.point.value > limit:
            problem.status = FitStatus.STALLED


def _limit(problems: Sequence[Descent], share: float) -> float:
    best = min(problem.point.value for problem in problems)
    return best + max(BEHIND_NATS, share * abs(best))


def _place(problem: Descent) -> Place:
    return Place(problem.point.latent, problem.point.pose)


def fit_of(problem: Descent, iterations_before: int = 0) -> Fit:
    """What a descent found."""
    point, status = problem.point, problem.status or FitStatus.ITERATION_LIMIT
    return Fit(
        point.latent,
        point.pose,
        status,
        status.sentence,
        iterations_before + problem.iterations,
        point.value,
        point.curvature,
    )
