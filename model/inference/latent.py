"""The latent code of a reconstruction as a feature vector, and the way from one code to another."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from model.bundle import ShapeModel
from model.errors import InvalidParameter
from model.geometry import Pose
from model.inference.fitting import Fit
from model.inference.mesh import Mesh
from model.inference.modes import ShapeModes
from model.inference.surface import require_spacing, surface_of


@dataclass(frozen=True)
class LatentFeatures:
    """A code beside the training population's; all vectors are over the latent dimensions.

    Attributes:
        latent: the code ``z``.
        posterior_sd: standard deviation of each of its entries given the drawing; None when it is not known.
        base: ``z0 = g(z)`` over sigma: standard normal over the prior.
        population_mean, population_sd: of the training codes.
        active: whether the dimension is among those that explain 99 % of the surface's variance.
    """

    latent: Float[np.ndarray, "d"]
    posterior_sd: Float[np.ndarray, "d"] | None
    base: Float[np.ndarray, "d"]
    population_mean: Float[np.ndarray, "d"]
    population_sd: Float[np.ndarray, "d"]
    active: Bool[np.ndarray, "d"]


def latent_features(
    model: ShapeModel, modes: ShapeModes, fit: Fit, covariance: Float[np.ndarray, "p p"] | None
) -> LatentFeatures:
    """The code of a fit as features.

    Args:
        covariance: posterior covariance over (latent, pose step); None without one.
    """
    size, codes = len(fit.latent), model.population.codes
    active = np.zeros(size, bool)
    active[[mode.dimension for mode in modes.ranked[: modes.active()[-1]]]] = True
    return LatentFeatures(
        latent=np.asarray(fit.latent, float),
        posterior_sd=None if covariance is None else np.sqrt(np.maximum(np.diag(covariance)[:size], 0.0)),
        base=standardised(model, fit.latent),
        population_mean=np.asarray(codes.mean(axis=0), float),
        population_sd=np.asarray(codes.std(axis=0), float),
        active=active,
    )


def standardised(model: ShapeModel, latent: Float[np.ndarray, "d"]) -> Float[np.ndarray, "d"]:
    """``g(z) / sigma``."""
    base = np.asarray(model.prior.to_base(latent[None])[0], float)
    return np.asarray(base / np.asarray(model.manifest.sigmas))


def code_between(
    model: ShapeModel, start: Float[np.ndarray, "d"], end: Float[np.ndarray, "d"], at: float
) -> Float[np.ndarray, "d"]:
    """Code on the way between two codes: the straight line in the base, its geodesic under the prior's metric.

    Args:
        at: 0 is the start, 1 the end.
    """
    if at in (0.0, 1.0):
        return np.asarray(end if at else start, float)
    first, last = model.prior.to_base(np.stack([start, end])).astype(float)
    return np.asarray(model.prior.from_base(((1.0 - at) * first + at * last)[None])[0])


def shape_between(
    model: ShapeModel,
    start: Float[np.ndarray, "d"],
    end: Float[np.ndarray, "d"],
    pose: Pose,
    at: float,
    spacing_mm: float | None = None,
) -> Mesh:
    """Surface on the way between two codes, in the world of a pose.

    Raises:
        InvalidParameter: `at` outside 0 to 1, a grid step outside 0.25 to 10 mm, or a code without a surface.
    """
    if not 0.0 <= at <= 1.0:
        raise InvalidParameter(f"at is {at:g}; from 0 (the first shape) to 1 (the other) is accepted.", part="at")
    require_spacing(spacing_mm)
    mesh = surface_of(model, code_between(model, start, end, at), pose, spacing_mm)
    if mesh.is_empty:
        raise InvalidParameter("There is no surface on this way; a place nearer to its ends is accepted.", part="at")
    return mesh
