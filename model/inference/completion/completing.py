"""From a fit and its drawing to the completed shape."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.inference.completion.drawn import drawn_at
from model.inference.completion.field import Completion
from model.inference.discrepancy.levels import saturated
from model.inference.fit_types import Fit
from model.inference.mask_stack import MaskStack
from model.inference.observations import Observations


def completed(
    model: ShapeModel, found: Fit, stacks: Sequence[MaskStack], observations: Observations
) -> Completion | None:
    """What the model's completion network makes of the drawing, seen from the fitted pose.

    Planes that the fit left out are left out. None for models without such a network, where it is not trusted, or
    where it finds no surface.
    """
    network, share = model.completer, model.manifest.completion.get("share", 0.0)
    if network is None or share <= 0.0:
        return None
    trust = np.ones(len(observations.planes)) if found.plane_weights is None else found.plane_weights
    planes = [plane for plane, weight in zip(observations.planes, trust, strict=True) if weight > 0]
    world = found.pose.to_world(network.lattice.points())
    reach = 0.5 * network.lattice.step_mm * float(np.exp(-found.pose.log_scale))
    drawn = drawn_at(world, reach, stacks, planes).reshape(2, *network.lattice.voxels)
    logits = network.logits(drawn)
    slope = _slope(logits, network.lattice.step_mm)
    return None if slope is None else Completion(network.lattice, saturated(logits / slope), share)


def _slope(logits: Float[np.ndarray, "i j k"], step_mm: float) -> float | None:
    """Median slope (1/mm) of the field where it changes sign; None where it does not."""
    steepness = np.linalg.norm(np.stack(np.gradient(logits, step_mm)), axis=0)
    near = np.abs(logits) < step_mm * steepness
    return float(np.median(steepness[near])) if near.any() else None
