"""What a completed drawing changes about the fitted shape, as a field of the canonical frame."""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates, spline_filter

from model.geometry import CanonicalLattice
from model.inference.differences import differences


@dataclass(frozen=True)
class Completion:
    """How much more (mm, positive inside) the distance from the surface is for a network having seen the drawing.

    Attributes:
        lattice: its place in the canonical frame.
        shifts: at the lattice's voxels; a cubic spline between them and 0 beyond.
    """

    lattice: CanonicalLattice
    shifts: Float[np.ndarray, "i j k"]

    def at(self, canonical: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        """The shift (mm) at canonical points."""
        places = self.lattice.places(canonical)
        return np.asarray(map_coordinates(self._splines, places, order=3, prefilter=False))

    def gradient(self, canonical: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Its gradient (mm by mm)."""
        return differences(self.at, canonical, self.at(canonical))

    def __getstate__(self) -> dict[str, object]:
        """What it was made of; the splines do not travel."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def _splines(self) -> Float[np.ndarray, "i j k"]:
        return np.asarray(spline_filter(self.shifts, order=3, output=np.float32))
