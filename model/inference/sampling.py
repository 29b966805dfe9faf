"""Synthetic shapes from the prior."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.inference.mesh import Mesh


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


def draw_shape(model: ShapeModel, seed: int, *, temperature: float = 1.0, spacing_mm: float | None = None) -> SampledShape:
    """One shape, a pure function of (bundle, seed, temperature, spacing).

    Raises:
        InvalidParameter: temperature outside (0, 2] or spacing outside [0.25, 10] mm.
    """
    raise NotImplementedError
