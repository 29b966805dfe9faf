"""The flow of a prior fitted to codes that stay as they are, with early stopping on codes held out.

Started from the identity, so that the flow is never worse on the held-out codes than the Gaussian base alone. They are
codes of shapes that the decoder was trained on, and what little a flow gains on them is not there on other shapes, but
its bends are: distances in the base no longer say how far surfaces are apart. So there is none unless it gains enough.
"""

import copy
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from model.networks.prior import LatentPrior

#: AdamW steps at most, its learning rate and weight decay.
STEPS, LEARNING_RATE, WEIGHT_DECAY = 1500, 1e-3, 1e-3
#: The held-out codes are judged every so many steps; so often without a better figure ends the fit.
JUDGE_EVERY, PATIENCE = 25, 8
#: One group in so many is held out; about so many draws of held-out codes; codes of a step at most.
HELD_EVERY, JUDGED, BATCH = 5, 1000, 256
#: A flow that gains less than this on held-out codes (nats a dimension) is not kept.
LEAST_GAIN = 0.1


@dataclass(frozen=True)
class Codes:
    """Gaussian codes of shapes.

    Attributes:
        mean, deviation: (m, d); points have no deviation.
        group: (m,) codes of one group, a shape and its mirror image, are held out together.
        axes: (e, d) rows along which the deviations, (m, e) then, lie; along the coordinates when None.
    """

    mean: Float[Tensor, "m d"]
    deviation: Float[Tensor, "m e"]
    group: Int[Tensor, "m"]
    axes: Float[Tensor, "e d"] | None = None

    def of(self, chosen: Tensor) -> "Codes":
        """The chosen codes."""
        return Codes(self.mean[chosen], self.deviation[chosen], self.group[chosen], self.axes)

    def draw(self, generator: torch.Generator) -> Float[Tensor, "m d"]:
        """One draw of each."""
        apart = self.deviation * torch.randn(self.deviation.shape, generator=generator)
        return self.mean + (apart if self.axes is None else apart @ self.axes)


@dataclass(frozen=True)
class Background:
    """A Gaussian about the centre of the codes that stands for shapes that are not among them.

    Attributes:
        share: of the population, from 0 to 1.
        factor: (e, d) a draw is a standard normal row times it.
    """

    share: float
    factor: Float[Tensor, "e d"]

    def mixed_with(self, draws: Float[Tensor, "m d"], generator: torch.Generator) -> Float[Tensor, "m d"]:
        """Draws of codes, about this share of them replaced by draws of the background."""
        own = torch.randn(len(draws), len(self.factor), generator=generator) @ self.factor
        return torch.where(torch.rand(len(draws), 1, generator=generator) < self.share, own, draws)


def fitted_prior(
    prior: LatentPrior, codes: Codes, background: Background | None = None, seed: int = 0
) -> tuple[LatentPrior, float]:
    """A prior of the same shape and sigmas whose flow is fitted to the codes and the background.

    The background is what keeps a flow from narrowing a base again that was widened for shapes that are not among the
    codes (`training.shrinkage`).

    Returns:
        The prior, and what its flow adds to the mean log density of the held-out codes (nats); where that is too
        little it has no flow, and 0.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        fitted = LatentPrior(prior.shape)
    fitted.log_sigma.data.copy_(prior.log_sigma)
    fitted.log_sigma.requires_grad_(False)
    held = codes.group % HELD_EVERY == 0
    if not prior.shape.use_flow or held.all() or not held.any():
        return _without_flow(fitted), 0.0
    return _descend(fitted, codes.of(~held), codes.of(held), background, torch.Generator().manual_seed(seed))


def _descend(
    prior: LatentPrior, seen: Codes, unseen: Codes, background: Background | None, generator: torch.Generator
) -> tuple[LatentPrior, float]:
    judged = torch.cat([_draws(unseen, background, generator) for _ in range(-(-JUDGED // len(unseen.mean)))])
    start = _score(prior, judged)
    best, best_flow, waited = start, copy.deepcopy(prior.flow.state_dict()), 0
    optimiser = torch.optim.AdamW(prior.flow.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    for step in range(1, STEPS + 1):
        chosen = torch.randperm(len(seen.mean), generator=generator)[:BATCH]
        loss = -prior.log_density(_draws(seen.of(chosen), background, generator)).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        if step % JUDGE_EVERY == 0:
            score, waited = _score(prior, judged), waited + 1
            if score > best:
                best, best_flow, waited = score, copy.deepcopy(prior.flow.state_dict()), 0
            if waited == PATIENCE:
                break
    if best - start < LEAST_GAIN * judged.shape[1]:
        return _without_flow(prior), 0.0
    prior.flow.load_state_dict(best_flow)
    return prior.eval(), best - start


@torch.no_grad()
def _without_flow(prior: LatentPrior) -> LatentPrior:
    """The base of a prior by itself."""
    shape = replace(prior.shape, use_flow=False, flow=replace(prior.shape.flow, transforms=0))
    result = LatentPrior(shape)
    result.log_sigma.copy_(prior.log_sigma)
    return result.requires_grad_(False).eval()


def _draws(codes: Codes, background: Background | None, generator: torch.Generator) -> Float[Tensor, "m d"]:
    draws = codes.draw(generator)
    return draws if background is None else background.mixed_with(draws, generator)


@torch.no_grad()
def _score(prior: LatentPrior, codes: Float[Tensor, "n d"]) -> float:
    return float(prior.log_density(codes).mean())
