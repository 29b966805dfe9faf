"""A convolutional network that fills in what lies between drawn planes, on a lattice of the canonical frame.

It sees which voxels of the lattice were drawn inside and which outside, and answers occupancy logits for all of them: a
U-Net (Cicek et al. 2016) with residual blocks. Its first and last layers work on blocks of two voxels along each axis,
which keeps the step of the lattice and an eighth of the arithmetic. The coordinates of the blocks are inputs as well:
in the canonical frame, a place says which part of the object it is likely to be.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

#: Voxels along each axis are a multiple of it: blocks of two, halved twice.
MULTIPLE = 8
#: Groups of channels that are normalised together.
GROUPS = 4


@dataclass(frozen=True)
class CompletionShape:
    """Size of the network.

    Attributes:
        voxels: of the lattice along R, A and S, multiples of `MULTIPLE`.
        width: channels at the finest level; two and four times as many below.
    """

    voxels: tuple[int, int, int]
    width: int = 24


class ResidualBlock(nn.Module):
    """Two convolutions around which the input is led."""

    def __init__(self, channels: int, made: int) -> None:
        super().__init__()
        self.first, self.second = (nn.Conv3d(count, made, 3, padding=1) for count in (channels, made))
        self.first_norm, self.second_norm = (nn.GroupNorm(GROUPS, made) for _ in range(2))
        self.around = nn.Conv3d(channels, made, 1)

    def forward(self, value: Float[Tensor, "b c i j k"]) -> Float[Tensor, "b m i j k"]:
        """The block's output."""
        inner = functional.silu(self.first_norm(self.first(value)))
        return functional.silu(self.second_norm(self.second(inner)) + self.around(value))


class CompletionNet(nn.Module):
    """Occupancy logits on a lattice from what was drawn of it."""

    places: Tensor

    def __init__(self, shape: CompletionShape) -> None:
        super().__init__()
        self.shape = shape
        width = shape.width
        self.down = nn.ModuleList(
            ResidualBlock(*channels) for channels in ((2 * 8 + 3, width), (width, 2 * width), (2 * width, 4 * width))
        )
        self.bottom = ResidualBlock(4 * width, 4 * width)
        self.up = nn.ModuleList(ResidualBlock(*channels) for channels in ((6 * width, 2 * width), (3 * width, width)))
        self.last = nn.Conv3d(width, 8, 1)
        places = torch.meshgrid(*(torch.linspace(-1.0, 1.0, count // 2) for count in shape.voxels), indexing="ij")
        self.register_buffer("places", torch.stack(places)[None], persistent=False)

    def forward(self, drawn: Float[Tensor, "b 2 i j k"]) -> Float[Tensor, "b i j k"]:
        """Logits; the channels of `drawn` are one where a voxel was drawn inside and outside."""
        value = torch.cat([blocks_of(drawn), self.places.expand(len(drawn), -1, -1, -1, -1)], dim=1)
        finest, middle, coarsest = self.down
        fine = finest(value)
        medium = middle(functional.avg_pool3d(fine, 2))
        low = self.bottom(coarsest(functional.avg_pool3d(medium, 2)))
        for block, passed in zip(self.up, (medium, fine), strict=True):
            low = block(torch.cat([passed, functional.interpolate(low, scale_factor=2.0, mode="trilinear")], dim=1))
        return voxels_of(self.last(low))[:, 0]


def blocks_of(value: Float[Tensor, "b c i j k"]) -> Float[Tensor, "b m p q r"]:
    """Blocks of two voxels along each axis as channels."""
    batch, channels, i, j, k = value.shape
    parts = value.reshape(batch, channels, i // 2, 2, j // 2, 2, k // 2, 2).permute(0, 1, 3, 5, 7, 2, 4, 6)
    return parts.reshape(batch, 8 * channels, i // 2, j // 2, k // 2)


def voxels_of(blocks: Float[Tensor, "b m p q r"]) -> Float[Tensor, "b c i j k"]:
    """The inverse of `blocks_of`."""
    batch, channels, i, j, k = blocks.shape
    parts = blocks.reshape(batch, channels // 8, 2, 2, 2, i, j, k).permute(0, 1, 5, 2, 6, 3, 7, 4)
    return parts.reshape(batch, channels // 8, 2 * i, 2 * j, 2 * k)
