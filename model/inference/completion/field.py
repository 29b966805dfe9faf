"""A completed drawing as a field: distances from its surface on a lattice, and how much they count where."""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates, spline_filter

from model.geometry import CanonicalLattice

#: Within so much (mm) of the lattice's border the completion counts less and less.
FADING_MM = 4.0
#: Step of the differences that give gradients (mm).
DIFFERENCE_MM = 0.02


@dataclass(frozen=True)
class Completion:
    """What the network makes of a drawing.

    Attributes:
        lattice: its place in the canonical frame.
        distances: signed distance from the completed surface (mm), positive inside, saturated.
        share: weight of these distances, beside those from the fitted surface, well within the lattice.
    """

    lattice: CanonicalLattice
    distances: Float[np.ndarray, "i j k"]
    share: float

    def weight(self, canonical: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """`share` well within the lattice, 0 on its border and beyond; smooth."""
        depth = np.clip((self.lattice.half_mm - np.abs(canonical)) / FADING_MM, 0.0, 1.0)
        return np.asarray(self.share * np.prod(depth * depth * (3.0 - 2.0 * depth), axis=1))

    def distance(self, canonical: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """Distance (mm) from the completed surface, a cubic spline of the lattice's."""
        places = self.lattice.places(canonical)
        return np.asarray(map_coordinates(self._splines, places, order=3, prefilter=False, mode="mirror"))

    def gradients(
        self, canonical: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Gradients (1/mm) of weight and distance, by differences."""
        weight, distance = self.weight(canonical), self.distance(canonical)
        shifted = [canonical + step for step in DIFFERENCE_MM * np.eye(3)]
        by_weight = np.stack([self.weight(points) - weight for points in shifted], axis=1)
        by_distance = np.stack([self.distance(points) - distance for points in shifted], axis=1)
        return by_weight / DIFFERENCE_MM, by_distance / DIFFERENCE_MM

    def __getstate__(self) -> dict[str, object]:
        """What it was made of; the splines do not travel."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def _splines(self) -> Float[np.ndarray, "i j k"]:
        return np.asarray(spline_filter(self.distances, order=3, output=np.float32))
