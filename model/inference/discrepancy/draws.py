"""A draw of the discrepancy from its posterior, by conditioning a draw of the prior.

``delta(x) + k(x, X) (K + noise)^-1 (observed - delta(X) - noise)`` with ``delta`` drawn before any contour was seen is
a draw afterwards (Matheron's rule; Wilson et al., Pathwise conditioning of Gaussian processes, 2021). The prior's draw
is exact on the process's lattice, whose covariance is a product over the axes.
"""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_solve
from scipy.ndimage import map_coordinates, spline_filter

from model.inference.discrepancy.process import Discrepancy


@dataclass(frozen=True)
class DrawnDiscrepancy(Discrepancy):
    """A draw: its `mean` is the drawn field.

    Attributes:
        seed: of the draw; the same one gives the same field.
        scale: factor on its distance from the posterior mean.
        offset_mm: added everywhere.
    """

    seed: int = 0
    scale: float = 1.0
    offset_mm: float = 0.0

    @cached_property
    def _nodes(self) -> Float[np.ndarray, "i j k"]:
        """The drawn field on the lattice (mm)."""
        random = np.random.default_rng(self.seed)
        prior = self.covariance.drawn_on(self._axes, random)
        splines = spline_filter(prior, order=3, output=np.float32)
        there = map_coordinates(splines, self._places(self.points), order=3, prefilter=False)
        noise = self.noise_mm * random.standard_normal(len(self.points))
        # The mean plus the scaled rest of the draw: both come from sums over the contours.
        rest = cho_solve(self._factor, self.residuals - self.scale * (there + noise))
        held = self.covariance.summed_on(self._axes, self.points, rest)
        return np.asarray(self.scale * prior + held + self.offset_mm, np.float32)


def drawn(discrepancy: Discrepancy, seed: int, scale: float = 1.0, offset_mm: float = 0.0) -> DrawnDiscrepancy:
    """A draw from the process's posterior, see `DrawnDiscrepancy`."""
    known = {f.name: getattr(discrepancy, f.name) for f in fields(Discrepancy)}
    return DrawnDiscrepancy(**known, seed=seed, scale=scale, offset_mm=offset_mm)
