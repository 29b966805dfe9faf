"""Which drawn plane contradicts all others, judged by what the fit gains from leaving it out.

At the optimum, leaving out plane ``k`` with cross-entropy ``E_k``, gradient ``g_k`` and curvature ``H_k`` lowers the
objective, to second order, by

    gain_k = E_k + 1/2 g_k^T (H - H_k)^-1 g_k

(one Newton step of the remaining objective from the optimum of all; Cook 1977). The second term is what the plane bends
the shape to its own will. A plane drawn as the others say gains a small multiple of the entropy ``S_k`` of labels drawn
from the field, the same multiple on every plane of a drawing. The planes that stand out are then left out for good, one
at a time, and the one whose absence explains most is blamed, or doubted when it stands out less.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve

from model.bundle import ShapeModel
from model.geometry import Pose
from model.inference.descent import descend
from model.inference.fit_types import Fit, FitOptions
from model.inference.objective import BaseJacobian, DataTerm, LinearPrior, Objective, Place, Point
from model.inference.observations import Observations, thinned

#: With fewer planes than this, nothing tells which of them is wrong.
FEWEST_JUDGED = 4
#: At most one plane among so many is left out.
PLANES_PER_WRONG = 4
#: Planes that stand out by this factor on few observations are tried on all.
TRIAL_RATIO = 2.5
#: The plane blamed gains so many times, and so many nats, more than is typical, of so many planes.
BLAME_RATIO, BLAME_NATS = 4.0, 20.0
#: The plane doubted gains so many times, and so many nats, more.
DOUBT_RATIO, DOUBT_NATS = 3.0, 15.0
#: Of more planes than this, the one that stands out most has to do so by more: by this power of their number.
FEW_PLANES, DEMAND = 8, 1.0 / 3.0
#: A thorough search is for drawings of no more planes than this.
MOST_SEARCHED = 12
#: What a plane's gain is held against is at least this share of the median plane's.
SMALLEST_SHARE = 1.0
#: What remains of the curvature without a plane is at least this share of it in each parameter.
CURVATURE_FLOOR = 1e-4


#: Trials see one observation of so many, but not fewer than these altogether.
TRIAL_EVERY, TRIAL_FEWEST = 4, 300
#: They start from the optimum of all and end at this predicted decrease (nats) or, the first time, after so many
#: iterations.
TRIAL_TOLERANCE, TRIAL_ITERATIONS = 0.5, 8


@dataclass(frozen=True)
class Verdict:
    """What leaving out one plane does.

    Attributes:
        plane: its number.
        gain: decrease of the objective (nats).
        typical: what it would be if the plane agreed with the others as they do among themselves (nats).
        among: how many planes it is the worst of.
    """

    plane: int
    gain: float
    typical: float
    among: int

    @property
    def excess(self) -> float:
        """How much more than typical (nats)."""
        return self.gain - self.typical

    @property
    def ratio(self) -> float:
        """How many times more than typical."""
        return self.gain / max(self.typical, 1e-9)

    @property
    def blamed(self) -> bool:
        """Whether the plane contradicts all others."""
        return self._stands_out(BLAME_RATIO, BLAME_NATS)

    @property
    def doubted(self) -> bool:
        """Whether it stands out, though perhaps for the shape's sake."""
        return self._stands_out(DOUBT_RATIO, DOUBT_NATS)

    def _stands_out(self, ratio: float, nats: float) -> bool:
        demand = max(1.0, self.among / FEW_PLANES) ** DEMAND
        return bool(self.ratio > demand * ratio and self.excess > demand * nats)


def most_wrong(observations: Observations) -> int:
    """How many planes may be left out at most: a share of those that show the object, which empty ones do not judge."""
    planes = np.unique(observations.plane_of[(observations.weights > 0) & (observations.labels > 0)])
    return len(planes) // PLANES_PER_WRONG if len(planes) >= FEWEST_JUDGED else 0


def contradicting_plane(
    model: ShapeModel,
    observations: Observations,
    found: Fit,
    start: Pose,
    options: FitOptions,
    every_plane: bool = False,
) -> Verdict | None:
    """On the plane whose absence explains most, if that is beyond what is typical of the drawing; otherwise None.

    Suspects are tried on few of the observations, and those that stand out there on all.

    Args:
        every_plane: whether each plane is tried on all observations instead, unless they are many. A fit that was bent
            far to the will of a wrong plane at the end of a drawing suspects others.
    """
    start = replace(start, mirrored=found.pose.mirrored)
    quick = replace(options, tolerance=TRIAL_TOLERANCE, max_iterations=TRIAL_ITERATIONS)
    tried = np.unique(observations.plane_of[observations.weights > 0])
    if not every_plane or len(tried) > MOST_SEARCHED:
        tried = _standing_out(model, observations, found, start, quick)
    if not tried.size:
        return None
    thorough = replace(quick, max_iterations=options.max_iterations)
    worst = max(verdicts(model, observations, found, start, thorough, tried), key=lambda one: one.excess)
    return worst if worst.doubted else None


def _standing_out(
    model: ShapeModel, observations: Observations, found: Fit, start: Pose, options: FitOptions
) -> Int[np.ndarray, "s"]:
    """Suspects that gain much from being left out of few observations."""
    # Trials take the prior as it is around the optimum: steps are small, and its network is not asked again.
    tangent = LinearPrior.around(model.prior, found.latent).base_jacobian
    every = min(TRIAL_EVERY, len(observations.points) // TRIAL_FEWEST)
    rough = verdicts(model, thinned(observations, every, seed=0), found, start, options, base_jacobian=tangent)
    return np.array([one.plane for one in rough if one.ratio > TRIAL_RATIO], dtype=int)


def verdicts(
    model: ShapeModel,
    observations: Observations,
    found: Fit,
    start: Pose,
    options: FitOptions,
    tried: Int[np.ndarray, "s"] | None = None,
    base_jacobian: BaseJacobian | None = None,
) -> list[Verdict]:
    """Planes left out in turn (the suspects when none are named), each judged by the planes that remain."""
    place = Place(found.latent, found.pose)
    whole = Objective(model, observations, start, options, base_jacobian)
    terms = whole.by_plane(place)
    seen = np.flatnonzero([term.expected > 0 for term in terms])
    if tried is None:
        gains = leave_out_gains(terms, whole.gathered(place, terms).curvature, seen)
        tried = suspects(gains, typical_gains(terms, gains), seen)
    if not tried.size:
        return []
    partial = [Objective(model, one, start, options, base_jacobian) for one in _without_each(observations, tried)]
    reference, *trials = descend([whole, *partial], [place] * (1 + len(tried)), 1.0, options)
    return [
        _verdict(whole, reference.point.value, trial.point, int(number), seen)
        for number, trial in zip(tried, trials, strict=True)
    ]


def _verdict(whole: Objective, value: float, point: Point, number: int, seen: Int[np.ndarray, "j"]) -> Verdict:
    place = Place(point.latent, point.pose)
    after = whole.by_plane(place)
    rest = whole.gathered(place, [term for plane, term in enumerate(after) if plane != number])
    typical = typical_gains(after, leave_out_gains(after, rest.curvature, seen[seen != number]))
    return Verdict(number, value - point.value, float(typical[number]), len(seen))


def _without_each(observations: Observations, numbers: Int[np.ndarray, "s"]) -> list[Observations]:
    return [
        replace(observations, weights=observations.weights * (observations.plane_of != number)) for number in numbers
    ]


def leave_out_gains(
    terms: Sequence[DataTerm], precision: Float[np.ndarray, "p p"], judged: Int[np.ndarray, "j"]
) -> Float[np.ndarray, "k"]:
    """Decrease of the objective (nats) when each judged plane is left out, to second order; NaN for the others."""
    gains = np.full(len(terms), np.nan)
    for number in judged:
        gains[number] = terms[number].value + _relaxation(terms[number], precision)
    return gains


def _relaxation(term: DataTerm, precision: Float[np.ndarray, "p p"]) -> float:
    rest = precision - term.curvature + CURVATURE_FLOOR * np.diag(np.diag(precision))
    return 0.5 * float(term.gradient @ cho_solve(cho_factor(rest), term.gradient))


def typical_gains(terms: Sequence[DataTerm], gains: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """What each plane would gain (nats) if it agreed no worse than the median of those whose gains are known."""
    entropies, judges = np.array([term.expected for term in terms]), np.isfinite(gains)
    sizes = np.maximum(entropies, SMALLEST_SHARE * float(np.median(entropies[judges])))
    return np.asarray(sizes * float(np.median(gains[judges] / sizes[judges])))


def suspects(
    gains: Float[np.ndarray, "k"], typical: Float[np.ndarray, "k"], seen: Int[np.ndarray, "j"]
) -> Int[np.ndarray, "s"]:
    """Planes worth a second look: the two largest each by ratio and by difference to what is typical."""
    ratio = gains[seen] / np.maximum(typical[seen], 1e-9)
    by_ratio, by_excess = np.argsort(-ratio)[:2], np.argsort(typical[seen] - gains[seen])[:2]
    tried = np.unique(np.concatenate([by_ratio, by_excess]))
    return np.asarray(seen[tried[ratio[tried] > 1.0]])
