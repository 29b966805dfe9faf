"""Point samples of training shapes, held on the training device and drawn there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True)
class ShapePoints:
    """Labelled points of one shape in the canonical frame.

    Attributes:
        points: (n, 3) mm.
        labels: (n,) occupancy 0 or 1.
        near: (n,) within the narrow band around the contour.
    """

    points: Float[np.ndarray, "n 3"]
    labels: Bool[np.ndarray, "n"]
    near: Bool[np.ndarray, "n"]

    def reflected(self) -> "ShapePoints":
        """The shape's mirror image: R is reversed."""
        return ShapePoints(self.points * np.array([-1.0, 1.0, 1.0], np.float32), self.labels, self.near)


@dataclass(frozen=True)
class Batch:
    """Points drawn for some shapes.

    Each shape's weighted sum estimates the sum over all its points, divided by the number of its near ones.
    """

    points: Float[Tensor, "b n 3"]
    labels: Float[Tensor, "b n"]
    weights: Float[Tensor, "b n"]


class PointPool:
    """All points of all shapes in two strata, near and far, ragged arrays flattened on one device."""

    def __init__(self, shapes: Sequence[ShapePoints], device: torch.device) -> None:
        self.device = device
        self.size = len(shapes)
        self._strata = [_Stratum(shapes, near, device) for near in (True, False)]

    def draw(self, chosen: Int[Tensor, "b"], counts: tuple[int, int], generator: torch.Generator) -> Batch:
        """Draw ``counts`` (near, far) points of each chosen shape, with replacement."""
        parts = [s.draw(chosen, n, generator) for s, n in zip(self._strata, counts, strict=True)]
        near, far = (s.count[chosen] for s in self._strata)
        band = torch.where(near > 0, near, far).clamp(min=1).float()
        weights = [
            (s.count[chosen].float() / band / max(1, n))[:, None].expand(-1, n)
            for s, n in zip(self._strata, counts, strict=True)
        ]
        points, labels = (torch.cat(values, dim=1) for values in zip(*parts, strict=True))
        return Batch(points, labels, torch.cat(weights, dim=1))


class _Stratum:
    def __init__(self, shapes: Sequence[ShapePoints], near: bool, device: torch.device) -> None:
        chosen = [s.near == near for s in shapes]
        counts = np.array([c.sum() for c in chosen])
        self.count = torch.from_numpy(counts).to(device)
        self.start = torch.from_numpy(np.concatenate([[0], np.cumsum(counts)[:-1]])).to(device)
        # One point behind the last: a shape without points in this stratum reads it, with weight 0.
        points = np.concatenate([*(s.points[c] for s, c in zip(shapes, chosen, strict=True)), np.zeros((1, 3))])
        labels = np.concatenate([*(s.labels[c] for s, c in zip(shapes, chosen, strict=True)), np.zeros(1, bool)])
        self.points = torch.from_numpy(points.astype(np.float32)).to(device)
        self.labels = torch.from_numpy(labels.astype(np.float32)).to(device)

    def draw(
        self, chosen: Int[Tensor, "b"], number: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b n"]]:
        uniform = torch.rand(len(chosen), number, generator=generator, device=self.points.device)
        count = self.count[chosen][:, None]
        index = self.start[chosen][:, None] + torch.minimum((uniform * count).long(), (count - 1).clamp(min=0))
        return self.points[index], self.labels[index]
