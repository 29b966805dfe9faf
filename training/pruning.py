"""Relevance of a trained model's dimensions, the ones that matter alone, and the prior fitted to their codes.

Of codes that are points, a dimension is dead along which they hardly differ. What it adds at its mean goes into biases,
so the field of the pruned decoder is that of the whole one with dead dimensions at their mean. The flow is
autoregressive: dead dimensions enter the conditioners of live ones as their mean too, transform after transform.
Between transforms a dead dimension may follow live ones a little; `Pruned.base_change` measures what that alters.

`refitted` goes on with codes that are Gaussians, and with all of their dimensions: one that says little of the training
shapes may still be what another shape needs. It turns them to the principal movements of the surface
(`training.principal`) and determines relevance there in closed form: with the decoder given, the evidence is largest
where a sigma is the root mean square of its coordinate over the posteriors of all codes (MacKay 1995; Bishop 1999 for
principal components), here of their shrunk covariance (`training.shrinkage`). Coordinates that then move next to
nothing are left out, and the flow is fitted to the codes in those that stay.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from model.errors import InvalidParameter
from model.networks.decoder import OccupancyDecoder
from model.networks.flow import MaskedLinear, SplineTransform
from model.networks.prior import LatentPrior
from model.networks.splines import parameter_count
from training.autodecoder import AutoDecoder
from training.choices import LEAST_MOVEMENT, LEAST_OF_TRAINING
from training.principal import principal_axes, turned_decoder
from training.prior_fit import Background, Codes, fitted_prior
from training.shrinkage import shrunk_covariance

#: A dimension is dead along which the standard deviation of codes that are points is below this share of the largest.
LEAST_SHARE = 0.02


@dataclass(frozen=True)
class PriorParts:
    """What is fitted to the codes of a finished run.

    Attributes:
        flow: whether there is a flow; the base is the prior otherwise.
        ard: whether irrelevant dimensions are left out; all stay otherwise.
        least_movement: a dimension is irrelevant whose principal movement is below this share of the largest.
        least_of_training: a prior that stood still in the training keeps at least this share of the codes' covariance.
        keep_centre: whether the centre stays where the prior of the training has it, or is that of the codes.
    """

    flow: bool = True
    ard: bool = True
    least_movement: float = LEAST_MOVEMENT
    least_of_training: float = LEAST_OF_TRAINING
    keep_centre: bool = False


@dataclass(frozen=True)
class Pruned:
    """Networks over the live dimensions alone.

    Attributes:
        live: numbers of these dimensions in the whole code.
        codes: (m, k) training codes; in principal coordinates there may be fewer of them than live dimensions.
        nats: (d,) mean divergence of the codes from the prior along each dimension of the whole code; NaN where codes
            are points.
        base_change: largest change of a live base coordinate of a training code, in sigmas, with the flow as it was.
        trained_sigmas: (d,) of the whole prior.
        flow_gain: what the flow that was fitted anew adds to the log density of held-out codes (nats); None before.
        fitted: the parts of the prior that `refitted` made, in the coordinates of `training.principal`; None before.
        shrinkage: share of the prior of the training in the covariance of the codes; None before.
    """

    decoder: OccupancyDecoder
    prior: LatentPrior
    live: Int[np.ndarray, "n"]
    codes: Float[Tensor, "m k"]
    nats: Float[np.ndarray, "d"]
    base_change: float
    trained_sigmas: Float[np.ndarray, "d"]
    flow_gain: float | None = None
    fitted: PriorParts | None = None
    shrinkage: float | None = None

    def facts(self) -> dict[str, object]:
        """What the manifest says of it."""
        return {
            "dimensions_before": len(self.nats),
            "live": self.live.tolist(),
            "rule": self.rule(),
            "nats": [None if np.isnan(value) else float(value) for value in self.nats],
            "largest_base_change_in_sigmas": self.base_change,
            "trained_sigmas": self.trained_sigmas.tolist(),
            "fitted": None if self.fitted is None else asdict(self.fitted),
            "shrinkage": self.shrinkage,
            "flow_gain_nats": self.flow_gain,
        }

    def rule(self) -> str:
        """By what dimensions were kept, in words."""
        if self.fitted is None:
            return f"standard deviation of the codes at least {LEAST_SHARE:g} of the largest"
        moving = f"movement at least {self.fitted.least_movement:g} of the largest"
        return moving if self.fitted.ard and self.fitted.least_movement > 0.0 else "all"


@torch.no_grad()
def pruned(module: AutoDecoder) -> Pruned:
    """Decoder and prior without dead dimensions; with all of them where codes are Gaussians.

    Raises:
        InvalidParameter: all dimensions are dead.
    """
    nats, live = divergences(module), live_dimensions(module)
    if not live.any():
        raise InvalidParameter("All dimensions are dead; a run with at least one live one is accepted.", part="prune")
    kept, codes = torch.from_numpy(np.flatnonzero(live)), module.code_means()
    centre = codes.mean(dim=0)
    decoder = pruned_decoder(module.decoder, kept, centre)
    prior = pruned_prior(module.prior, kept, centre)
    whole = module.prior.to_base(codes)[0][:, kept] / module.prior.sigma[kept]
    change = (prior.to_base(codes[:, kept])[0] / prior.sigma - whole).abs().max()
    sigmas = np.asarray(module.prior.sigma.numpy(), float)
    return Pruned(decoder.eval(), prior.eval(), kept.numpy(), codes[:, kept], nats, float(change), sigmas)


def refitted(
    module: AutoDecoder, shapes: int, half_extent_mm: Sequence[float], parts: PriorParts | None = None
) -> Pruned:
    """The networks in principal coordinates with a prior fitted to the codes; just pruned where codes are points.

    Args:
        shapes: number of training shapes; codes beyond are those of their mirror images, in the same order.
        half_extent_mm: half sides of the box that holds all surfaces.
        parts: what is fitted; all when None.
    """
    parts = PriorParts() if parts is None else parts
    less = pruned(module)
    if not module.random:
        return less
    codes, target = gaussian_codes(module, shapes)
    least_share = 0.0 if module.config.prior.use_ard else parts.least_of_training
    covariance, share = shrunk_covariance(codes, target, least_share)
    with torch.no_grad():
        centre = torch.zeros(codes.mean.shape[1]) if parts.keep_centre else codes.mean.mean(dim=0)
        axes = principal_axes(less.decoder, codes.mean, covariance, half_extent_mm, centre)
        least = parts.least_movement if parts.ard else 0.0
        moving = torch.arange(int((axes.sigma >= least * axes.sigma[0]).sum()))
        decoder = pruned_decoder(turned_decoder(less.decoder, axes), moving, torch.zeros(len(axes.sigma)))
        turned = Codes(axes.of(codes.mean)[:, moving], codes.deviation, codes.group, axes.axes[:, moving])
        background = Background(
            share, (torch.linalg.cholesky(target.double()).T @ axes.axes.double()[:, moving]).float()
        )
    prior, gain = fitted_prior(gaussian_prior(module, axes.sigma[moving], flow=parts.flow), turned, background)
    return replace(
        less, decoder=decoder.eval(), prior=prior, codes=turned.mean, flow_gain=gain, fitted=parts, shrinkage=share
    )


@torch.no_grad()
def gaussian_codes(module: AutoDecoder, shapes: int) -> tuple[Codes, Float[Tensor, "d d"]]:
    """Codes of a training as Gaussians, and the covariance of the prior that they were trained under."""
    means = module.code_means()
    everyone = torch.arange(len(means))
    deviation = module.log_deviations(everyone).exp()
    return Codes(means, deviation, everyone % shapes), torch.diag(module.prior.sigma.square())


@torch.no_grad()
def gaussian_prior(module: AutoDecoder, sigma: Float[Tensor, "k"], *, flow: bool) -> LatentPrior:
    """The prior of these sigmas whose flow, if it is to have one, is the identity yet."""
    shape = module.prior.shape
    prior = LatentPrior(replace(shape, flow=replace(shape.flow, latent_size=len(sigma)), use_flow=flow))
    prior.log_sigma.copy_(sigma.log())
    return prior


@torch.no_grad()
def divergences(module: AutoDecoder) -> Float[np.ndarray, "d"]:
    """Mean over the training shapes of ``KL(q_i || N(0, sigma_i^2))`` (nats); NaN where codes are points."""
    codes, sigma = module.code_means(), module.prior.sigma
    if not module.random:
        return np.full(len(sigma), np.nan)
    everyone = torch.arange(len(codes))
    spread = (module.log_deviations(everyone) - module.prior.log_sigma).exp()
    nats = 0.5 * (spread.square() + (codes / sigma).square() - 1.0) - spread.log()
    return np.asarray(nats.mean(dim=0).numpy(), float)


@torch.no_grad()
def live_dimensions(module: AutoDecoder) -> Bool[np.ndarray, "d"]:
    """Dimensions along which codes that are points differ; all of Gaussian codes."""
    codes = module.code_means()
    if module.random:
        return np.ones(codes.shape[1], bool)
    scale = codes.std(dim=0).numpy()
    return np.asarray(scale >= LEAST_SHARE * scale.max())


@torch.no_grad()
def pruned_decoder(decoder: OccupancyDecoder, live: Int[Tensor, "k"], centre: Float[Tensor, "d"]) -> OccupancyDecoder:
    """The decoder over live dimensions; the others stand at their centre."""
    result = OccupancyDecoder(replace(decoder.shape, latent_size=len(live)))
    state = decoder.state_dict()
    result.load_state_dict({**state, "from_latent": state["from_latent"][:, live]})
    fixed = centre.clone()
    fixed[live] = 0.0
    for layer, weights in zip(result.from_point, decoder.latent_weights(), strict=True):
        layer.bias.add_(weights @ fixed)
    return result


@torch.no_grad()
def pruned_prior(prior: LatentPrior, live: Int[Tensor, "k"], centre: Float[Tensor, "d"]) -> LatentPrior:
    """The prior over live dimensions; the others stand at their centre in every conditioner."""
    shape = replace(prior.shape, flow=replace(prior.shape.flow, latent_size=len(live)))
    result = LatentPrior(shape)
    result.log_sigma.copy_(prior.log_sigma[live])
    value = (centre / prior.flow_scale())[None]
    for whole, part in zip(prior.flow.transforms, result.flow.transforms, strict=True):
        _prune_transform(whole, part, live, value[0])
        value, _ = whole(value)
    return result


def _prune_transform(
    whole: SplineTransform, part: SplineTransform, live: Int[Tensor, "k"], value: Float[Tensor, "d"]
) -> None:
    fixed = value.clone()
    fixed[live] = 0.0
    size = parameter_count(whole.shape.bins)
    rows = (live[:, None] * size + torch.arange(size)).reshape(-1)
    _fill(part.first, whole.first.weight[:, live], whole.first.mask[:, live], whole.first.bias)
    part.first.bias.add_(whole.first.masked() @ fixed)
    _fill(part.second, whole.second.weight, whole.second.mask, whole.second.bias)
    _fill(part.last, whole.last.weight[rows], whole.last.mask[rows], whole.last.bias[rows])


def _fill(layer: MaskedLinear, weight: Tensor, mask: Tensor, bias: Tensor) -> None:
    layer.weight.copy_(weight)
    layer.mask.copy_(mask)
    layer.bias.copy_(bias)
