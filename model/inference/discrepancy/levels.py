"""How far a point is from the fitted surface, as far as it counts.

Near the surface the fitted logit ``l`` tells the distance (mm): ``C tanh(l / (C g))`` with ``g`` the field's slope
there (1/mm) and ``C`` a distance beyond which nothing more is said. Where a network has completed the drawing, its
shift is added. What the drawing leaves open of the shape it leaves open to the network as well: the code's posterior
stands for both, so a step of the code moves the surface as it does without the network.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from model.inference.completion.field import Completion

#: ``C``: distances from the surface count up to about this (mm).
REACH_MM = 3.0


def saturated(distances: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """Distances (mm) as far as they count."""
    return np.asarray(REACH_MM * np.tanh(distances / REACH_MM))


@dataclass(frozen=True)
class Levels:
    """Distances in the canonical frame by the decoder's logits.

    Attributes:
        slope: ``g`` (1/mm).
        completion: what a network made of the drawing; None without.
    """

    slope: float
    completion: Completion | None = None

    def of_code(self, logits: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """What code and pose alone say (mm)."""
        return saturated(logits / self.slope)

    def at(self, logits: Float[np.ndarray, "n"], canonical: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Distance (mm) at canonical points where the decoder gives these logits."""
        own = self.of_code(logits)
        return own if self.completion is None else np.asarray(own + self.completion.at(canonical))

    def by_logit(self, logits: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Derivative of the distance by the logit (mm)."""
        return np.asarray((1.0 - np.square(np.tanh(logits / (REACH_MM * self.slope)))) / self.slope)

    def gradient(
        self, logits: Float[np.ndarray, "n"], by_point: Float[np.ndarray, "n 3"], canonical: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Gradient of the distance where the decoder gives these logits and derivatives by canonical point (1/mm)."""
        own = self.by_logit(logits)[:, None] * by_point
        return own if self.completion is None else np.asarray(own + self.completion.gradient(canonical))
