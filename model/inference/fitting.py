"""Maximum a posteriori fit of latent code and pose to observations, by damped Gauss-Newton.

From every start the fit goes coarse to fine: first few observations and blunt logits, which widens the basin of
attraction, then all of them. Starts that fall behind are given up on the way. A plane that contradicts all others is
then left out (`model.inference.leave_out`). The objective is that of `model.inference.objective`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from model.bundle import ShapeModel
from model.errors import InvalidMask
from model.geometry import Pose
from model.inference.descent import Descent, Referee, descend
from model.inference.fit_types import Fit, FitOptions, FitStatus, MirrorRule
from model.inference.leave_out import contradicting_plane, most_wrong
from model.inference.objective import Objective, Place, pose_offset, reweighted
from model.inference.observations import Observations, thinned
from model.inference.rivals import rival_of
from model.inference.screening import screened_poses

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
    "starting_poses",
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
#: Objects fill about this share of the model's box; a drawing shorter than the second share of that may be of one end.
MEAN_SHARE, SHORT_SHARE = 0.8, 0.55
#: A plane shows the object's extent along axes that it is inclined to by less than this (sine).
IN_PLANE = 0.4
#: A section of fewer observations tells no normal.
FEWEST_IN_SECTION = 10
#: On so few planes the drawing's centroid says little about the object's.
FEW_PLANES = 2


@dataclass(frozen=True)
class Start:
    """A pose that a fit starts from, and the one that its prior is around."""

    pose: Pose
    around: Pose


def fit(model: ShapeModel, observations: Observations, options: FitOptions) -> Fit:
    """The best of the fits from every starting pose that the options allow, less planes that contradict the others."""
    found = _from_starts(model, observations, _starts(model, observations, options), options)
    return _without_wrong_planes(model, observations, found, options) if options.robust else found


def _starts(model: ShapeModel, observations: Observations, options: FitOptions) -> list[Start]:
    """The starting poses, those beyond a short drawing, and where so few planes, or the caller, want it many more."""
    poses = starting_poses(observations, options)
    usual = [Start(pose, pose) for pose in [*poses, *_poses_beyond(model, observations, poses)]]
    if not options.screened and len(np.unique(observations.plane_of[observations.weights > 0])) > FEW_PLANES:
        return usual
    return usual + [
        Start(screened, pose)
        for pose in poses
        for screened in screened_poses(model, observations, pose, COARSE_SHARPNESS)
    ]


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
        anew = _from_starts(model, trusted, [Start(pose, pose) for pose in poses], options)
        on = _from_place(model, trusted, found, poses[0], options)
        found = min(anew, on, key=lambda one: one.objective)
    return replace(found, plane_weights=trust, doubted=doubted)


def _from_place(model: ShapeModel, observations: Observations, found: Fit, start: Pose, options: FitOptions) -> Fit:
    """Go on from another fit, with the pose's prior around a start."""
    objective = Objective(model, observations, replace(start, mirrored=found.pose.mirrored), options)
    anew = fit_of(descend([objective], [Place(found.latent, found.pose)], 1.0, options)[0], found.iterations)
    return replace(anew, rival=found.rival)


def refit(model: ShapeModel, observations: Observations, found: Fit, options: FitOptions) -> Fit:
    """Go on from a fit after its observations were moved; planes that it left out stay out."""
    if found.plane_weights is not None:
        observations = reweighted(observations, found.plane_weights)
    anew = _from_place(model, observations, found, starting_poses(observations, options)[0], options)
    return replace(anew, plane_weights=found.plane_weights, doubted=found.doubted, rival=found.rival)


def starting_poses(observations: Observations, options: FitOptions) -> Sequence[Pose]:
    """Poses at the centroid of the drawn foreground, one for each side and orientation that may be tried.

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
    turns = [np.eye(3)]
    if options.any_orientation:
        turns += [Rotation.from_rotvec(np.pi * axis).as_matrix() for axis in np.eye(3)]
    return [Pose(centre, turn, mirrored=side) for side in sides for turn in turns]


def _poses_beyond(model: ShapeModel, observations: Observations, poses: Sequence[Pose]) -> list[Pose]:
    """Poses with the object's middle to both sides of the drawing, where that is short for an object of this kind.

    From the centroid of one drawn end the fit would turn and squeeze the object into that end.
    """
    drawn = (observations.labels > 0) & (observations.weights > 0)
    inside, plane_of = observations.points[drawn], observations.plane_of[drawn]
    sizes = 2.0 * MEAN_SHARE * np.asarray(model.manifest.half_extent_mm)
    # Between slices, half a gap to either side of the drawing may hold some of the object as well.
    extents = np.ptp(inside, axis=0) * (1.0 + 1.0 / max(len(np.unique(plane_of)) - 1, 1))
    shares = np.where(_shown(inside, plane_of), np.inf, extents / sizes)
    axis = int(np.argmin(shares))
    if shares[axis] > SHORT_SHARE:
        return []
    shift = 0.5 * (sizes[axis] - extents[axis]) * np.eye(3)[axis]
    return [replace(pose, position=pose.position + side * shift) for pose in poses for side in (-1.0, 1.0)]


def _shown(points: Float[np.ndarray, "n 3"], plane_of: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "3"]:
    """Along which axes some plane shows the whole extent, its section being closed."""
    shown = np.zeros(3, bool)
    for number in np.unique(plane_of):
        section = points[plane_of == number]
        if len(section) >= FEWEST_IN_SECTION:
            shown |= np.abs(np.linalg.svd(section - section.mean(axis=0), full_matrices=False)[2][2]) < IN_PLANE
    return shown


def fit_from(
    model: ShapeModel,
    observations: Observations,
    start: Pose,
    options: FitOptions,
    latent: Float[np.ndarray, "d"] | None = None,
) -> Fit:
    """Fit from one starting pose, and one starting code (the centre of the latent space when None)."""
    (coarse,) = _coarse(model, observations, [Start(start, start)], options, latent=latent)
    (fine,) = descend([Objective(model, observations, start, options)], [_place(coarse)], 1.0, options)
    return fit_of(fine, coarse.iterations)


def _from_starts(model: ShapeModel, observations: Observations, starts: Sequence[Start], options: FitOptions) -> Fit:
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
    referee: Referee = lambda problems: None,
    latent: Float[np.ndarray, "d"] | None = None,
) -> list[Descent]:
    """The first stage, from all starts side by side: blunt logits on few observations."""
    rough = thinned(observations, _coarse_step(len(observations.points)), seed=0)
    code = np.zeros(model.manifest.latent_size) if latent is None else latent
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
