"""From a fit and its drawing to the completed shape."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from model.bundle import ShapeModel
from model.geometry import CanonicalLattice
from model.inference.completion.drawn import drawn_at
from model.inference.completion.field import Completion
from model.inference.discrepancy.levels import REACH_MM, saturated
from model.inference.fit_types import Fit
from model.inference.mask_stack import MaskStack
from model.inference.observations import Observations
from model.inference.posterior import laplace_covariance

#: Position of the object, as an SD of the fit in steps of the lattice, up to which the network counts in full. It was
#: trained on poses a little off; where two or three planes leave the place open it sees parts that it takes for others.
PLACED_STEPS = 0.64
#: Within so much (mm) of the lattice's border the completion counts less and less.
FADING_MM = 4.0


def completed(
    model: ShapeModel, found: Fit, stacks: Sequence[MaskStack], observations: Observations, slope: float
) -> Completion | None:
    """What the model's completion network makes of the drawing, seen from the fitted pose, beside the code's shape.

    The distance from the surface becomes ``(1 - w) m + w c``, with ``c`` the network's and ``w`` its share, less where
    the fit does not know the place. Planes that the fit left out are left out. None for models without such a network,
    where it is not trusted, or where it finds no surface.

    Args:
        slope: of the decoder's field at the surface (1/mm).
    """
    network, share = model.completer, model.manifest.completion.get("share", 0.0)
    if network is None or share <= 0.0:
        return None
    trust = np.ones(len(observations.planes)) if found.plane_weights is None else found.plane_weights
    planes = [plane for plane, weight in zip(observations.planes, trust, strict=True) if weight > 0]
    points = network.lattice.points()
    reach = 0.5 * network.lattice.step_mm * float(np.exp(-found.pose.log_scale))
    drawn = drawn_at(found.pose.to_world(points), reach, stacks, planes).reshape(2, *network.lattice.voxels)
    logits = network.logits(drawn)
    steepness = _slope(logits, network.lattice.step_mm)
    if steepness is None:
        return None
    more = saturated(logits / steepness) - saturated(code_logits(model, found, network.lattice, slope) / slope)
    return Completion(
        network.lattice, share * trust_in_place(found, network.lattice) * weights_of(network.lattice) * more
    )


def code_logits(model: ShapeModel, found: Fit, lattice: CanonicalLattice, slope: float) -> Float[np.ndarray, "i j k"]:
    """The code's logits on a lattice; interpolated from every other voxel where distances hardly count any more.

    Args:
        slope: of the decoder's field at the surface (1/mm).
    """
    points = lattice.points().reshape(*lattice.voxels, 3)
    coarse = points[::2, ::2, ::2]
    known = model.decoder.logits(found.latent[None], coarse.reshape(1, -1, 3))[0].reshape(coarse.shape[:3])
    logits = map_coordinates(known, np.indices(lattice.voxels) / 2.0, order=3, mode="nearest")
    near = np.abs(logits) < REACH_MM * slope
    logits[near] = model.decoder.logits(found.latent[None], points[near][None])[0]
    return np.asarray(logits)


def trust_in_place(found: Fit, lattice: CanonicalLattice) -> float:
    """1 where the SD of the fitted position is up to `PLACED_STEPS`, falling with its variance beyond."""
    size = len(found.latent)
    position = laplace_covariance(found)[size : size + 3, size : size + 3]
    sd = float(np.sqrt(np.trace(position) / 3.0) * np.exp(found.pose.log_scale))
    return min(1.0, (PLACED_STEPS * lattice.step_mm / sd) ** 2)


def weights_of(lattice: CanonicalLattice) -> Float[np.ndarray, "i j k"]:
    """1 well within a lattice and 0 on its border, smooth."""
    depth = np.clip((lattice.half_mm - np.abs(lattice.points())) / FADING_MM, 0.0, 1.0)
    return np.asarray(np.prod(depth * depth * (3.0 - 2.0 * depth), axis=1).reshape(lattice.voxels), np.float32)


def _slope(logits: Float[np.ndarray, "i j k"], step_mm: float) -> float | None:
    """Median slope (1/mm) of the field where it changes sign; None where it does not."""
    if not (np.isfinite(logits).all() and logits.min() < 0.0 < logits.max()):
        return None
    steepness = np.linalg.norm(np.stack(np.gradient(logits, step_mm)), axis=0)
    near = np.abs(logits) < step_mm * steepness
    return float(np.median(steepness[near])) if near.any() else None
