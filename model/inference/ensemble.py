"""Ensemble of refits from different slice configurations and starting points (MorphoFlow paper, section 3)."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from model.bundle import ShapeModel
from model.inference.descent import descend
from model.inference.fitting import Fit, FitOptions, fit_of
from model.inference.objective import LinearPrior, Objective, Place, reweighted
from model.inference.observations import Observations, thinned
from model.inference.posterior import laplace_covariance

#: Members of an ensemble, as in the paper.
MEMBERS = 25
#: Members end at this predicted decrease (nats), below the spread between them; the last step is still taken.
TOLERANCE = 1.0
#: Members see one observation of so many.
EVERY = 2
#: Starts are spread about the predicted optima by this share of the posterior SD.
START_SPREAD = 0.5


def fit_ensemble(
    model: ShapeModel, observations: Observations, found: Fit, seed: int, members: int = MEMBERS
) -> tuple[Fit, ...]:
    """Refits under random weights of the planes (Bayesian bootstrap, Rubin 1981), each from a random start.

    Members advance side by side; planes that the fit left out stay out. What each plane says at the fit tells to
    second order where a member will end; it starts around there.
    """
    random = np.random.default_rng(seed)
    planes = len(observations.planes)
    shares = [random.dirichlet(np.ones(planes)) * planes * _trust(found, planes) for _ in range(members)]
    fewer = thinned(observations, EVERY, seed=seed)
    options = FitOptions(robust=False, tolerance=TOLERANCE)
    tangent = LinearPrior.around(model.prior, found.latent).base_jacobian
    here = Place(found.latent, found.pose)
    predicted = _predicted(Objective(model, fewer, found.pose, options, tangent), here, shares)
    spread = START_SPREAD * np.linalg.cholesky(laplace_covariance(found))
    starts = [here.moved(step + spread @ random.standard_normal(len(step))) for step in predicted]
    objectives = [Objective(model, reweighted(fewer, share), found.pose, options, tangent) for share in shares]
    return tuple(fit_of(problem) for problem in descend(objectives, starts, 1.0, options))


def _predicted(
    objective: Objective, here: Place, shares: Sequence[Float[np.ndarray, "k"]]
) -> Iterator[Float[np.ndarray, "p"]]:
    """Newton's step from a place to the optimum under each weighting of the planes."""
    terms = objective.by_plane(here)
    for share in shares:
        point = objective.gathered(here, [term.times(part) for term, part in zip(terms, share, strict=True)])
        yield -cho_solve(cho_factor(point.curvature), point.gradient)


def _trust(found: Fit, planes: int) -> Float[np.ndarray, "k"]:
    return np.ones(planes) if found.plane_weights is None else found.plane_weights
