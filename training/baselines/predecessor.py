"""The predecessor's fit: the latent code of a frozen decoder by 1200 steps of Adam over all annotated voxels.

After Amiranashvili et al. (Medical Image Analysis, 2024): binary cross-entropy plus soft Dice, a code drawn near zero,
no prior. The predecessor's shapes stood in the training frame; here the pose starts at the centroid of the drawn
foreground, where the project's own fit starts, and the position is optimised with the code.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from model.bundle import Manifest
from model.geometry import Grid
from model.inference.mask_stack import MaskStack, Plane, section_of
from training.objective import cross_entropy_loss, soft_dice_loss

#: Annotated voxels this far (mm) beyond the model's box around the start are left out: the decoder knows nothing there.
MARGIN_MM = 10.0
#: Points of the dense grid that are decoded at a time.
CHUNK = 1 << 16


@dataclass(frozen=True)
class AdamSettings:
    """How Adam runs.

    Attributes:
        steps: of Adam.
        rate: learning rate of the code.
        position_rate_mm: learning rate of the position (mm).
        initial_sd: standard deviation of the code at the start.
        seed: of the code at the start.
    """

    steps: int = 1200
    rate: float = 0.01
    position_rate_mm: float = 0.1
    initial_sd: float = 0.01
    seed: int = 0


@dataclass(frozen=True)
class AdamFit:
    """Code and position (world mm of the canonical origin) after the last step."""

    code: Float[Tensor, "1 d"]
    position: Float[Tensor, "3"]


class TorchDecoder:
    """The decoder of a bundle as TorchScript, which autograd can go through."""

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self.latent_size = manifest.latent_size
        self.half_extent = np.array(manifest.half_extent_mm)
        self.logits = torch.jit.load(folder / "decoder_logits.pt")


def fit_by_adam(
    decoder: TorchDecoder, stacks: Sequence[MaskStack], planes: Sequence[Plane], settings: AdamSettings
) -> AdamFit:
    """Fit code and position to every annotated voxel."""
    points, labels = annotated_voxels(stacks, planes)
    start = points[labels].mean(axis=0)
    near = (np.abs(points - start) <= decoder.half_extent + MARGIN_MM).all(axis=1)
    world, wanted = torch.tensor(points[near] - start).float(), torch.tensor(labels[near])[None].float()
    generator = torch.Generator().manual_seed(settings.seed)
    code = (settings.initial_sd * torch.randn(1, decoder.latent_size, generator=generator)).requires_grad_(True)
    offset = torch.zeros(3, requires_grad=True)
    groups = [{"params": [code], "lr": settings.rate}, {"params": [offset], "lr": settings.position_rate_mm}]
    optimiser = torch.optim.Adam(groups)
    weights = torch.full_like(wanted, 1.0 / wanted.shape[1])
    for _ in range(settings.steps):
        logits = decoder.logits(code, (world - offset)[None])
        loss = (cross_entropy_loss(logits, wanted, weights) + soft_dice_loss(logits, wanted, weights)).sum()
        code.grad, offset.grad = torch.autograd.grad(loss, [code, offset])
        optimiser.step()
    return AdamFit(code.detach(), offset.detach() + torch.tensor(start).float())


def filled(decoder: TorchDecoder, found: AdamFit, target: Grid) -> Bool[np.ndarray, "i j k"]:
    """Voxels of a grid whose centre lies inside the fitted shape."""
    canonical = torch.tensor(target.centres()).float() - found.position
    inside = (canonical.abs() <= torch.tensor(decoder.half_extent + MARGIN_MM)).all(dim=1)
    result = torch.zeros(len(canonical), dtype=torch.bool)
    with torch.no_grad():
        parts = [decoder.logits(found.code, part[None])[0] > 0 for part in canonical[inside].split(CHUNK)]
    result[inside] = torch.cat([result[:0], *parts])
    return np.asarray(result.numpy().reshape(target.shape))


def annotated_voxels(
    stacks: Sequence[MaskStack], planes: Sequence[Plane]
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """World positions (mm) and labels of all voxels on the planes that were looked at, each once."""
    points, labels = [], []
    for number, stack in enumerate(stacks):
        seen = np.zeros(stack.grid.shape, bool)
        for plane in planes:
            if plane.stack == number:
                section_of(seen, plane)[...] = True
        index = np.argwhere(seen & ~stack.excluded)
        points.append(stack.grid.to_world(index.astype(float)))
        labels.append(stack.foreground[tuple(index.T)])
    return np.concatenate(points), np.concatenate(labels)
