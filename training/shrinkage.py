"""Covariance of latent codes that also describes the codes of shapes that were not among them.

With hundreds of shapes and dozens of dimensions the codes' own covariance is too narrow along some directions and too
wide along others. It is shrunk towards the covariance of the prior that the codes were trained under (Ledoit and Wolf
2004 shrink to a multiple of the identity), by the share under which codes that were left out are most probable.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from training.prior_fit import Codes

#: Shares of the target that are tried.
SHARES = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
#: Parts that are left out in turn.
PARTS = 5


def shrunk_covariance(
    codes: Codes, target: Float[Tensor, "d d"], least: float = 0.0
) -> tuple[Float[Tensor, "d d"], float]:
    """Covariance of Gaussian codes, shrunk towards a target.

    Args:
        codes: along their coordinates; those of one group are left out together.
        target: (d, d) positive definite, in the squared units of the codes.
        least: share of the target at least, from 0 to 1.

    Returns:
        The (d, d) covariance in double precision, and the target's share in it.
    """
    shares = [share for share in SHARES if share >= least]
    scores = dict.fromkeys(shares, 0.0)
    for part in range(PARTS):
        out = codes.group % PARTS == part
        if not out.any() or out.all():
            continue
        centre, covariance = _moments(codes.of(~out))
        scatter = _scatter(codes.of(out), centre) * out.sum()
        for share in shares:
            scores[share] += _log_density(_mixed(covariance, target, share), scatter, int(out.sum()))
    best = max(shares, key=lambda share: scores[share])
    return _mixed(_moments(codes)[1], target, best), best


def _moments(codes: Codes) -> tuple[Float[Tensor, "d"], Float[Tensor, "d d"]]:
    centre = codes.mean.double().mean(dim=0)
    return centre, _scatter(codes, centre)


def _scatter(codes: Codes, centre: Float[Tensor, "d"]) -> Float[Tensor, "d d"]:
    apart = codes.mean.double() - centre
    return apart.T @ apart / len(apart) + torch.diag(codes.deviation.double().square().mean(dim=0))


def _mixed(covariance: Float[Tensor, "d d"], target: Float[Tensor, "d d"], share: float) -> Float[Tensor, "d d"]:
    return (1.0 - share) * covariance + share * target.double()


def _log_density(covariance: Float[Tensor, "d d"], scatter: Float[Tensor, "d d"], count: int) -> float:
    """Expected log density of codes with this summed scatter, up to a constant (nats); none where it is singular."""
    factor, singular = torch.linalg.cholesky_ex(covariance)
    if singular:
        return -math.inf
    nats = count * 2.0 * factor.diagonal().log().sum() + torch.cholesky_solve(scatter, factor).trace()
    return -0.5 * float(nats)
