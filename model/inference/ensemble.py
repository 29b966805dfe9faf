"""Ensemble of refits from different slice configurations and starting points (MorphoFlow paper, section 3)."""

from dataclasses import replace

import numpy as np

from model.bundle import ShapeModel
from model.inference.fitting import Fit, FitOptions, fit_from
from model.inference.observations import Observations

#: Members of an ensemble, as in the paper.
MEMBERS = 25


def fit_ensemble(
    model: ShapeModel, observations: Observations, found: Fit, seed: int, members: int = MEMBERS
) -> tuple[Fit, ...]:
    """Refits under random weights of the planes (Bayesian bootstrap, Rubin 1981), each from a random start.

    The starting pose is the fit's; the starting code is drawn around the fit's by half a prior SD of the flow's base.
    """
    random = np.random.default_rng(seed)
    sigmas = np.asarray(model.manifest.sigmas)
    base = model.prior.to_base(found.latent[None]) + 0.5 * sigmas * random.standard_normal((members, len(sigmas)))
    fits = []
    for latent in model.prior.from_base(base):
        shares = random.dirichlet(np.ones(len(observations.planes))) * len(observations.planes)
        weighted = replace(observations, weights=observations.weights * shares[observations.plane_of])
        fits.append(fit_from(model, weighted, found.pose, FitOptions(), latent=latent))
    return tuple(fits)
