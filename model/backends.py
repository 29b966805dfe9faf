"""What inference needs of a network: the `Decoder` and `Prior` protocols.

ONNX Runtime stands behind them by default, TorchScript when asked for. Batches lead: ``b`` shapes
(starts, ensemble members, samples) are evaluated in one call, each with its own latent code.
"""

from typing import Protocol

import numpy as np
from jaxtyping import Float


class Decoder(Protocol):
    """Occupancy decoder ``f_theta(z, u)`` before its sigmoid, over canonical points (mm)."""

    latent_size: int

    def logits(self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n"]:
        """Occupancy logits; positive inside."""
        ...

    def logits_and_jacobians(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n d"], Float[np.ndarray, "b n 3"]]:
        """Logits with their derivatives by latent code and by point (per mm)."""
        ...


class Prior(Protocol):
    """Density of latent codes: a normalizing flow onto a diagonal Gaussian."""

    latent_size: int

    def log_density(self, latent: Float[np.ndarray, "b d"]) -> tuple[Float[np.ndarray, "b"], Float[np.ndarray, "b d"]]:
        """``log p(z)`` (nats) and its gradient."""
        ...

    def to_base(self, latent: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
        """``z0 = g(z)``."""
        ...

    def from_base(self, base: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
        """``z = g^-1(z0)``."""
        ...
