"""Where fits start: at the centroid of the drawing, beyond its ends, and where the mean shape agrees with it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from model.bundle import ShapeModel
from model.errors import InvalidMask
from model.geometry import Pose
from model.inference.fit_types import FitOptions
from model.inference.observations import Observations
from model.inference.screening import screened_poses

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
    """Where a fit starts.

    Attributes:
        pose: that it starts from, world to canonical.
        around: pose that its prior is around.
    """

    pose: Pose
    around: Pose


def starts_of(model: ShapeModel, observations: Observations, options: FitOptions, sharpness: float) -> list[Start]:
    """The starting poses, those beyond a short drawing, and screened ones where planes are few or options say so.

    Args:
        sharpness: what logits are multiplied by in the first stage of the fit.
    """
    poses = starting_poses(observations, options)
    usual = [Start(pose, pose) for pose in [*poses, *_poses_beyond(model, observations, poses)]]
    if not options.screened and not has_few_planes(observations):
        return usual
    return usual + [
        Start(screened, pose) for pose in poses for screened in screened_poses(model, observations, pose, sharpness)
    ]


def has_few_planes(observations: Observations) -> bool:
    """Whether a drawing is on so few planes that starts are always screened."""
    return len(np.unique(observations.plane_of[observations.weights > 0])) <= FEW_PLANES


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
    return [Pose(centre, mirrored=side) for side in sides]


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
