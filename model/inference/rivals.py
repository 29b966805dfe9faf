"""Other places that explain a drawing nearly as well as the best one.

The posterior around one optimum does not know of another.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from model.geometry import Pose
from model.inference.fit_types import Fit, Rival
from model.inference.objective import Point

#: An optimum is a rival when it is at most so much less probable (nats), one in twenty.
RIVAL_NATS = 3.0
#: It lies elsewhere when the object is farther away than this share of the model's smallest half length.
ELSEWHERE_SHARE = 0.25


def rival_of(best: Point, others: Sequence[Point], half_extent_mm: Float[np.ndarray, "3"]) -> Rival | None:
    """The most probable rival of the best one among optima of its side that lie elsewhere.

    A model that knows both sides may give the same surface by either; so the other side is no rival.
    """
    rivals = [
        Rival(other.value - best.value, distance_mm(best.pose, other.pose, half_extent_mm))
        for other in others
        if other.pose.mirrored == best.pose.mirrored and other.value - best.value <= RIVAL_NATS
    ]
    least = ELSEWHERE_SHARE * float(half_extent_mm.min())
    return min((one for one in rivals if one.distance_mm > least), key=lambda one: one.nats, default=None)


def distance_mm(one: Pose, other: Pose, half_extent_mm: Float[np.ndarray, "3"]) -> float:
    """RMS distance (world mm) between where two poses put points half-way to the sides of a box."""
    points = 0.5 * np.concatenate([np.eye(3), -np.eye(3)]) * half_extent_mm
    return float(np.sqrt(np.square(one.to_world(points) - other.to_world(points)).sum(axis=1).mean()))


def rival_warnings(found: Fit) -> tuple[str, ...]:
    """What to tell of a rival."""
    rival = found.rival
    if rival is None:
        return ()
    sentence = (
        f"A place {rival.distance_mm:.0f} mm away explains the drawing nearly as well (1 to {np.exp(rival.nats):.1f}); "
        "a further plane would tell them apart."
    )
    return (sentence,)
