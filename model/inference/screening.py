"""Where a fit may start: the mean shape in many places, held against the drawing.

The centroid of what was drawn is a good start when sections are spread over the object. That of two or three sections
of a vertebra's processes lies far from its middle, and from there the fit ends with a shape that misses the contours.
Placing the mean shape costs an evaluation of logits at few observations, so many places can be compared before any of
them is a start.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from model.bundle import ShapeModel
from model.geometry import Pose
from model.inference.observations import Observations, thinned

#: Places that are compared, and the most of them that become starts.
SCREENED, KEPT = 512, 4
#: SDs of the places: of the position, in half lengths of the model's box, and of the rotation (rad).
POSITION_SD, ROTATION_SD = 0.5, 0.1
#: Starts lie at least so far apart, in half lengths.
APART = 0.25
#: Observations that places are held against, about.
OBSERVED = 250


def screened_poses(model: ShapeModel, observations: Observations, pose: Pose, sharpness: float) -> list[Pose]:
    """At most `KEPT` poses (world to canonical) in which the mean shape agrees best with the drawing; the best first.

    Args:
        pose: that they lie around; a turned one has turned poses around it.
        sharpness: what logits are multiplied by.
    """
    seen = thinned(observations, max(1, len(observations.points) // OBSERVED), seed=0)
    half = np.asarray(model.manifest.half_extent_mm)
    places = list(_scattered(pose, half))
    points = np.concatenate([place.to_canonical(seen.points) for place in places])[None].astype(np.float32)
    centre = np.zeros((1, model.manifest.latent_size), np.float32)
    logits = sharpness * model.decoder.logits(centre, points).reshape(len(places), -1).astype(float)
    costs = (np.logaddexp(0.0, logits) - seen.labels * logits) @ seen.weights
    return _apart([places[number] for number in np.argsort(costs)], half)


def _scattered(pose: Pose, half: Float[np.ndarray, "3"]) -> Iterator[Pose]:
    """Poses around one: shifted by shares of the half lengths of the model's box (mm) along its axes, and turned."""
    for shift, turn in zip(*np.random.default_rng(0).standard_normal((2, SCREENED, 3)), strict=True):
        rotation = Rotation.from_rotvec(ROTATION_SD * turn).as_matrix() @ pose.rotation
        yield replace(pose, position=pose.position + pose.rotation.T @ (POSITION_SD * shift * half), rotation=rotation)


def _apart(poses: Sequence[Pose], half: Float[np.ndarray, "3"]) -> list[Pose]:
    """The first ones of those that do not lie close to one before them, in half lengths (mm) of the model's box."""
    kept: list[Pose] = []
    for pose in poses:
        shifts = [pose.rotation @ (pose.position - other.position) / half for other in kept]
        if len(kept) < KEPT and all(np.linalg.norm(shift) > APART for shift in shifts):
            kept.append(pose)
    return kept
