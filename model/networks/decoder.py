"""Occupancy decoder: an MLP over latent code and point, with its Jacobians written out.

The architecture follows the implicit auto-decoder of Amiranashvili et al. (MedIA 2024): latent code and
coordinates enter at the first layer and again half-way. Two departures: the activation is smooth (SiLU), so that
Newton steps and surface normals are exact, and each latent dimension's weights into the network have unit
norm, so that the scale of a latent dimension is the scale of its effect and ARD has something to select.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from model.errors import InvalidParameter


@dataclass(frozen=True)
class DecoderShape:
    """Sizes of a decoder.

    Attributes:
        latent_size: D.
        width: hidden units a layer.
        depth: hidden layers, at least 2.
        extent_mm: half size of the cube that is scaled to [-1, 1].
        unit_columns: latent weights of unit norm a dimension.
    """

    latent_size: int = 64
    width: int = 128
    depth: int = 6
    extent_mm: float = 32.0
    unit_columns: bool = True

    def __post_init__(self) -> None:
        if self.depth < 2:
            raise InvalidParameter("The decoder has fewer than 2 hidden layers; 2 or more are accepted.", part="depth")


class OccupancyDecoder(nn.Module):
    """``f_theta(z, u)`` before the sigmoid; points ``u`` in canonical mm."""

    def __init__(self, shape: DecoderShape) -> None:
        super().__init__()
        self.shape = shape
        self.second_entry = shape.depth // 2
        entries = nn.ModuleList([nn.Linear(3, shape.width) for _ in range(2)])
        self.from_point = cast("Sequence[nn.Linear]", entries)
        self.from_latent = nn.Parameter(torch.randn(2 * shape.width, shape.latent_size) / shape.width**0.5)
        hidden = nn.ModuleList([nn.Linear(shape.width, shape.width) for _ in range(shape.depth - 1)])
        self.hidden = cast("Sequence[nn.Linear]", hidden)
        self.out = nn.Linear(shape.width, 1)
        self._initialise()

    def _initialise(self) -> None:
        for layer in self.hidden:
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)
        for layer in self.from_point:
            nn.init.normal_(layer.weight, std=1.5)
            nn.init.uniform_(layer.bias, -1.0, 1.0)

    def latent_weights(self) -> tuple[Float[Tensor, "width d"], Float[Tensor, "width d"]]:
        """Weights of the latent code into its two entries."""
        weight = self.from_latent
        if self.shape.unit_columns:
            weight = weight / weight.norm(dim=0, keepdim=True)
        first, second = weight.split(self.shape.width)
        return first, second

    def _entry(
        self, which: int, latent: Float[Tensor, "b d"], scaled: Float[Tensor, "b n 3"]
    ) -> Float[Tensor, "b n width"]:
        bias = functional.linear(latent, self.latent_weights()[which])
        entry: Tensor = self.from_point[which](scaled) + bias[:, None, :]
        return entry

    def _pre_activations(
        self, latent: Float[Tensor, "b d"], points: Float[Tensor, "b n 3"]
    ) -> list[Float[Tensor, "b n width"]]:
        scaled = points / self.shape.extent_mm
        before = [self._entry(0, latent, scaled)]
        for number, layer in enumerate(self.hidden, start=1):
            value = layer(functional.silu(before[-1]))
            if number == self.second_entry:
                value = value + self._entry(1, latent, scaled)
            before.append(value)
        return before

    def forward(self, latent: Float[Tensor, "b d"], points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n"]:
        """Occupancy logits, positive inside.

        Args:
            latent: one code a shape.
            points: canonical frame, mm.
        """
        last = self._pre_activations(latent, points)[-1]
        logits: Tensor = self.out(functional.silu(last)).squeeze(-1)
        return logits

    def directional_derivative(
        self, latent: Float[Tensor, "b d"], points: Float[Tensor, "b n 3"], step: Float[Tensor, "d"]
    ) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n"]]:
        """Logits and their derivative along a step of the latent code, by one forward pass in plain operations.

        Args:
            latent: one code a shape.
            points: canonical frame, mm.
            step: the direction, the same for all shapes; the derivative is for the whole of it.
        """
        before = self._pre_activations(latent, points)
        first, second = (functional.linear(step, weights) for weights in self.latent_weights())
        tangent = first.expand_as(before[0])
        for number, layer in enumerate(self.hidden, start=1):
            tangent = functional.linear(silu_slope(before[number - 1]) * tangent, layer.weight)
            if number == self.second_entry:
                tangent = tangent + second
        logits = self.out(functional.silu(before[-1])).squeeze(-1)
        return logits, functional.linear(silu_slope(before[-1]) * tangent, self.out.weight).squeeze(-1)

    def jacobians(
        self, latent: Float[Tensor, "b d"], points: Float[Tensor, "b n 3"]
    ) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n d"], Float[Tensor, "b n 3"]]:
        """Logits with derivatives by latent code and by point (1/mm), by one backward pass in plain operations."""
        before = self._pre_activations(latent, points)
        logits = self.out(functional.silu(before[-1])).squeeze(-1)
        sensitivity = silu_slope(before[-1]) * self.out.weight
        entries = [sensitivity, sensitivity]
        for number in range(self.shape.depth - 1, 0, -1):
            if number == self.second_entry:
                entries[1] = sensitivity
            sensitivity = silu_slope(before[number - 1]) * (sensitivity @ self.hidden[number - 1].weight)
        entries[0] = sensitivity
        first, second = self.latent_weights()
        by_latent = entries[0] @ first + entries[1] @ second
        by_point = entries[0] @ self.from_point[0].weight + entries[1] @ self.from_point[1].weight
        return logits, by_latent, by_point / self.shape.extent_mm


def silu_slope(value: Float[Tensor, "*s"]) -> Float[Tensor, "*s"]:
    """Derivative of SiLU."""
    gate = torch.sigmoid(value)
    return gate * (1.0 + value * (1.0 - gate))
