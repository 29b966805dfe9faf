"""The joint objective of the MorphoFlow paper, and its variational form.

    L = L_rec + lambda_flow * L_prior + lambda_ARD * L_ARD

`paper`: L_prior = -log p(z) at the code. The others: the code is q(z) = N(mu, diag(s^2)) and
L_prior = E_q[log q(z) - log p(z)], one reparameterised draw a step. Free codes and a flexible flow make the first
unbounded below; the entropy of q bounds the second. `denoising` holds s fixed, `centred` learns mu and s, `variational`
learns mu / sigma and s / sigma (the non-centred form of Papaspiliopoulos et al. 2007).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from training.config import ReconstructionName


def soft_dice_loss(
    logits: Float[Tensor, "b n"], labels: Float[Tensor, "b n"], weights: Float[Tensor, "b n"]
) -> Float[Tensor, "b"]:
    """``1 - 2 sum(w p y) / sum(w (p + y))`` of each shape (L_rec of the paper)."""
    probability = torch.sigmoid(logits)
    overlap = (weights * probability * labels).sum(dim=-1)
    return 1.0 - 2.0 * overlap / ((weights * (probability + labels)).sum(dim=-1) + 1e-6)


def cross_entropy_loss(
    logits: Float[Tensor, "b n"], labels: Float[Tensor, "b n"], weights: Float[Tensor, "b n"]
) -> Float[Tensor, "b"]:
    """Weighted mean binary cross-entropy of each shape (nats a point)."""
    loss = functional.binary_cross_entropy_with_logits(logits, labels, reduction="none")
    return (weights * loss).sum(dim=-1)


def reconstruction_loss(
    name: ReconstructionName,
    logits: Float[Tensor, "b n"],
    labels: Float[Tensor, "b n"],
    weights: Float[Tensor, "b n"],
) -> Float[Tensor, "b"]:
    """The chosen reconstruction loss of each shape."""
    dice = soft_dice_loss(logits, labels, weights) if name != "bce" else 0.0
    cross_entropy = cross_entropy_loss(logits, labels, weights) if name != "dice" else 0.0
    return dice + cross_entropy  # type: ignore[return-value]


def unevenness(
    logits: Float[Tensor, "b n"], moved: Float[Tensor, "b n"], weights: Float[Tensor, "b n"]
) -> Float[Tensor, ""]:
    """Variance over shapes of how far one step of the code moves their surfaces, relative to the mean.

    A movement of the surface sweeps ``p (1 - p) |moved|`` of the points near it. Where it is the same for all shapes,
    the latent space has one metric, which a linear change of coordinates makes that of the surfaces' distances
    (isometric auto-encoders: Gropp et al. 2020). Two halves of a shape's points are multiplied, so that the scatter of
    what was drawn of it adds nothing on average.

    Args:
        logits: at random points near each shape's surface.
        moved: their derivatives along the step.
    """
    probability = torch.sigmoid(logits)
    swept = weights * probability * (1.0 - probability) * moved.abs()
    halves = torch.stack([swept[:, 0::2].sum(dim=1), swept[:, 1::2].sum(dim=1)])
    relative = halves / halves.mean().clamp(min=1e-9) - 1.0
    return (relative[0] * relative[1]).mean()


def gaussian_entropy(log_deviation: Float[Tensor, "b d"]) -> Float[Tensor, "b"]:
    """Entropy of a diagonal Gaussian (nats)."""
    return (log_deviation + 0.5 * (1.0 + math.log(2 * math.pi))).sum(dim=-1)
