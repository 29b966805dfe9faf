"""Ensemble of refits from different slice configurations and starting points (MorphoFlow paper, section 3)."""

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.inference.fitting import Fit, FitOptions, fit_together
from model.inference.objective import LinearPrior, Place, reweighted
from model.inference.observations import Observations, thinned

#: Members of an ensemble, as in the paper.
MEMBERS = 25
#: Members end at this predicted decrease (nats), far below the spread between them.
TOLERANCE = 0.3
#: Members see one observation of so many.
EVERY = 3


def fit_ensemble(
    model: ShapeModel, observations: Observations, found: Fit, seed: int, members: int = MEMBERS
) -> tuple[Fit, ...]:
    """Refits under random weights of the planes (Bayesian bootstrap, Rubin 1981), each from a random start.

    Members advance side by side; planes that the fit left out stay out. The starting pose is the fit's; the starting
    code is drawn around the fit's by half a prior SD of the flow's base.
    """
    random = np.random.default_rng(seed)
    sigmas = np.asarray(model.manifest.sigmas)
    base = model.prior.to_base(found.latent[None]) + 0.5 * sigmas * random.standard_normal((members, len(sigmas)))
    planes = len(observations.planes)
    shares = [random.dirichlet(np.ones(planes)) * planes * _trust(found, planes) for _ in range(members)]
    fewer = thinned(observations, EVERY, seed=seed)
    weighted = [reweighted(fewer, share) for share in shares]
    starts = [Place(latent, found.pose) for latent in model.prior.from_base(base)]
    options = FitOptions(robust=False, tolerance=TOLERANCE)
    tangent = LinearPrior.around(model.prior, found.latent).base_jacobian
    return tuple(fit_together(model, weighted, starts, options, coarse_sharpness=1.0, coarse_prior=tangent))


def _trust(found: Fit, planes: int) -> Float[np.ndarray, "k"]:
    return np.ones(planes) if found.plane_weights is None else found.plane_weights
