"""Stand-ins for completion networks whose answers are known."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float

from model.bundle import ShapeModel
from model.geometry import CanonicalLattice

LATTICE = CanonicalLattice((40, 40, 40), 1.0)


@dataclass
class KnownCompleter:
    """Answers a field of the canonical frame (distances, mm), whatever was drawn, and keeps what it was shown."""

    field: Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]]
    lattice: CanonicalLattice = LATTICE
    steepness: float = 2.5
    seen: list[Bool[np.ndarray, "2 i j k"]] = field(default_factory=list)

    def logits(self, drawn: Bool[np.ndarray, "2 i j k"]) -> Float[np.ndarray, "i j k"]:
        """See `model.backends.Completer`."""
        self.seen.append(drawn)
        values = self.steepness * self.field(self.lattice.points())
        return values.reshape(self.lattice.voxels).astype(np.float32)


@dataclass(frozen=True)
class BallCompleter:
    """Answers a ball around the middle of what was drawn inside: a function of the drawing alone."""

    radius_mm: float
    lattice: CanonicalLattice = LATTICE

    def logits(self, drawn: Bool[np.ndarray, "2 i j k"]) -> Float[np.ndarray, "i j k"]:
        """See `model.backends.Completer`."""
        points = self.lattice.points()
        centre = points[drawn[0].ravel()].mean(axis=0)
        values = self.radius_mm - np.linalg.norm(points - centre, axis=1)
        return values.reshape(self.lattice.voxels).astype(np.float32)


def completing(model: ShapeModel, completer: KnownCompleter | BallCompleter, share: float) -> ShapeModel:
    """The model with a completion network that has this weight."""
    return replace(model, completer=completer, manifest=replace(model.manifest, completion={"share": share}))
