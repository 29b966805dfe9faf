"""Held-out shapes during training: codes fitted with the networks frozen, and how well they explain the shapes."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from training.autodecoder import AutoDecoder
from training.config import TrainingConfig
from training.objective import cross_entropy_loss, soft_dice_loss
from training.samples import PointPool, ShapePoints

#: Adam steps of the fit, its learning rate, and points drawn a shape and step (near, far).
STEPS, LEARNING_RATE, POINTS = 60, 0.05, (192, 64)


class Validation:
    """Fits codes of held-out shapes from scratch each time.

    Its random stream is its own: training is the same with and without it.
    """

    def __init__(self, config: TrainingConfig, shapes: Sequence[ShapePoints]) -> None:
        self._config = config
        self._pool = PointPool(shapes, torch.device(config.device))

    def figures(self, module: AutoDecoder) -> dict[str, float]:
        """Cross-entropy (nats a band voxel), soft Dice, and negative log prior density (nats) over held-out shapes."""
        codes = self.fitted(module)
        with torch.no_grad():
            density = -module.prior.log_density(codes).mean()
        cross_entropy, dice = self.agreement(module, codes)
        return {
            "validation/cross_entropy": cross_entropy,
            "validation/dice": dice,
            "validation/negative_log_density": density.item(),
        }

    def fitted(self, module: AutoDecoder) -> Float[Tensor, "m d"]:
        """Code of each held-out shape: mode of likelihood and prior, by a fixed number of Adam steps from zero."""
        generator, chosen = self._generator(0), self._all()
        size = self._config.decoder.latent_size
        codes = torch.zeros(self._pool.size, size, device=self._pool.device, requires_grad=True)
        optimiser = torch.optim.Adam([codes], LEARNING_RATE)
        weight = self._config.objective.lambda_flow
        for _ in range(STEPS):
            batch = self._pool.draw(chosen, POINTS, generator)
            fit = cross_entropy_loss(module.decoder(codes, batch.points), batch.labels, batch.weights)
            loss = (fit - weight * module.prior.log_density(codes)).sum()
            (codes.grad,) = torch.autograd.grad(loss, codes)
            optimiser.step()
        return codes.detach()

    def agreement(self, module: AutoDecoder, codes: Float[Tensor, "m d"]) -> tuple[float, float]:
        """Cross-entropy (nats a band voxel) and soft Dice of codes on points that they were not fitted to."""
        batch = self._pool.draw(self._all(), (8 * POINTS[0], 8 * POINTS[1]), self._generator(1))
        with torch.no_grad():
            logits = module.decoder(codes, batch.points)
            cross_entropy = cross_entropy_loss(logits, batch.labels, batch.weights).mean()
            dice = 1.0 - soft_dice_loss(logits, batch.labels, batch.weights).mean()
        return cross_entropy.item(), dice.item()

    def _generator(self, stream: int) -> torch.Generator:
        return torch.Generator(device=self._pool.device).manual_seed(2 * self._config.seed + stream)

    def _all(self) -> Int[Tensor, "m"]:
        return torch.arange(self._pool.size, device=self._pool.device)
