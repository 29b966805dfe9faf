"""Synthetic shapes from the prior."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.errors import InvalidParameter
from model.geometry import Pose
from model.inference.mesh import Mesh
from model.inference.surface import require_spacing, surface_of

#: Accepted temperatures: above 0, at most this.
HIGHEST_TEMPERATURE = 2.0


@dataclass(frozen=True)
class SampledShape:
    """One draw, in the model's canonical frame (RAS mm).

    Attributes:
        latent: (d,) latent code.
        log_density: of the latent code (nats).
        nearest_training_distance: distance in z0, in units of sigma, to the nearest training code.
        mesh: its surface.
    """

    latent: Float[np.ndarray, "d"]
    log_density: float
    nearest_training_distance: float
    mesh: Mesh


def draw_shape(
    model: ShapeModel, seed: int, *, temperature: float = 1.0, spacing_mm: float | None = None
) -> SampledShape:
    """One shape, a pure function of (bundle, seed, temperature, spacing).

    Args:
        seed: non-negative.
        temperature: factor on the standard deviations of the base, in (0, 2].
        spacing_mm: grid step of the surface, 0.25 to 10; the model's own when None.

    Raises:
        InvalidParameter: an argument out of its range.
    """
    _check(seed, temperature, spacing_mm)
    sigmas = np.asarray(model.manifest.sigmas)
    base = temperature * sigmas * np.random.default_rng(seed).standard_normal(len(sigmas))
    latent = model.prior.from_base(base[None])[0]
    gap = np.linalg.norm((model.population.base_codes - base) / sigmas, axis=1)
    return SampledShape(
        latent=latent,
        log_density=float(model.prior.log_density(latent[None])[0][0]),
        nearest_training_distance=float(gap.min()),
        mesh=surface_of(model, latent, Pose(), spacing_mm),
    )


def _check(seed: int, temperature: float, spacing_mm: float | None) -> None:
    if seed < 0:
        raise InvalidParameter(f"seed is {seed}; a whole number from 0 is accepted.", part="seed")
    if not 0.0 < temperature <= HIGHEST_TEMPERATURE:
        raise InvalidParameter(
            f"temperature is {temperature:g}; above 0 and at most {HIGHEST_TEMPERATURE:g} is accepted.",
            part="temperature",
        )
    require_spacing(spacing_mm)
