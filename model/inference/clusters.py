"""Draws of the prior where the training shapes are, and not between two kinds of them.

A population of two kinds, such as left and right organs, has its codes in two clusters. No smooth flow onto one
Gaussian leaves the gap between them empty, and draws from there are neither one kind nor the other. So draws are
thinned along the direction that parts the clusters until they are spread as the codes are: one is kept with a
probability in proportion to the ratio of the codes' density to the base's (rejection sampling, von Neumann 1951). Both
clusters are Gaussians of one covariance, as the base is, so that the ratio depends on one coordinate alone (Fisher's
discriminant).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from model.bundle import Manifest

#: Where the largest ratio of the densities is looked for (SDs of the base).
RANGE = np.linspace(-6.0, 6.0, 1201)
#: So many draws in a row are thinned out at most; the next one stands.
MOST_THINNED = 200


@dataclass(frozen=True)
class Clusters:
    """Two clusters of base codes along one direction.

    Attributes:
        direction: (d,) unit vector in base coordinates over their sigmas.
        shares: of the codes in either cluster; they add up to 1.
        means, sd: of the clusters along the direction, in SDs of all codes.
    """

    direction: Float[np.ndarray, "d"]
    shares: tuple[float, float]
    means: tuple[float, float]
    sd: float

    def kept(self, standard: Float[np.ndarray, "d"]) -> float:
        """Probability with which a draw stays.

        Args:
            standard: a draw of the base over its sigmas.
        """
        return float(self._ratio(np.asarray(standard @ self.direction)) / self._largest)

    def _ratio(self, at: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
        """Density of the codes by that of the base."""
        exponents = [0.5 * (at**2 - ((at - mean) / self.sd) ** 2) for mean in self.means]
        return np.asarray(sum(share / self.sd * np.exp(e) for share, e in zip(self.shares, exponents, strict=True)))

    def as_values(self) -> dict[str, Any]:
        """As a manifest holds them; inverse of `clusters_of`."""
        values = {"direction": self.direction.tolist(), "shares": list(self.shares), "means": list(self.means)}
        return {**values, "sd": self.sd}

    @cached_property
    def _largest(self) -> float:
        return float(self._ratio(RANGE).max())


def clusters_of(manifest: Manifest) -> Clusters | None:
    """Those of a model's training codes; None where they are of one kind."""
    known = manifest.clusters
    if not known:
        return None
    (first, second), (low, high) = known["shares"], known["means"]
    return Clusters(np.asarray(known["direction"], float), (first, second), (low, high), known["sd"])


def drawn_base(
    sigmas: Float[np.ndarray, "d"], clusters: Clusters | None, stream: np.random.Generator, temperature: float = 1.0
) -> tuple[Float[np.ndarray, "d"], int]:
    """Base coordinates of one draw, and how many before it lay between clusters.

    Args:
        sigmas: standard deviations of the base.
        clusters: None thins nothing out.
        temperature: factor on the standard deviations.
    """
    thinned = 0
    while True:
        standard = temperature * stream.standard_normal(len(sigmas))
        if clusters is None or thinned == MOST_THINNED or stream.random() < clusters.kept(standard):
            return sigmas * standard, thinned
        thinned += 1
