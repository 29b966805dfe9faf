"""Laplace and the ensemble beside a No-U-Turn sampler (Hoffman and Gelman 2014, by Pyro) of the same posterior.

The posterior is that of code and pose given the observations of one drawing, without a discrepancy: what all three
methods approximate. It is sampled in the coordinates in which Laplace's approximation is standard normal. Compared are
first-order movements of the fitted surface: logits at its vertices over the field's slope there.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from pyro.infer.mcmc import MCMC, NUTS

from benchmarks.uncertainty.cells import Payload
from model.bundle import ShapeModel
from model.geometry import Pose
from model.inference.ensemble import fit_ensemble
from model.inference.estimates import interval_reach
from model.inference.fitting import Fit, FitOptions, fit
from model.inference.mesh import Mesh, vertex_areas
from model.inference.objective import Objective
from model.inference.observations import Observations, observe, thinned
from model.inference.posterior import fitted_jacobians, fitted_logits, laplace_covariance, normal_displacements
from model.inference.reconstruction import OBSERVATION_BUDGET
from model.inference.starts import starting_poses
from model.inference.surface import surface_of
from training.cohorts.cohort import Case
from training.sparsify import Regime, for_evaluation

#: One observation of so many is used by all methods: a draw costs dozens of evaluations.
EVERY = 4
WARM_UP, DRAWS, DEEPEST = 150, 300, 6
#: Vertices that are compared, about.
VERTICES = 300


@dataclass(frozen=True)
class Posterior:
    """The exact negative log posterior (nats) of one drawing, in whitened coordinates about the fit.

    Attributes:
        root: (p, p) with ``root root^T`` Laplace's covariance.
    """

    objective: Objective
    found: Fit
    root: Float[np.ndarray, "p p"]

    def place(self, whitened: Float[np.ndarray, "p"]) -> Fit:
        """Code and pose at a point."""
        step = self.root @ whitened
        return replace(self.found, latent=self.found.latent + step[:-7], pose=self.found.pose.moved(step[-7:]))

    def at(self, whitened: Float[np.ndarray, "p"]) -> tuple[float, Float[np.ndarray, "p"]]:
        """Value and gradient; the prior is the flow's density of the code itself, determinant and all."""
        here, step = self.place(whitened), self.root @ whitened
        point = self.objective.at(here.latent, here.pose)
        prior = self.objective.model.prior
        base, slope = (part[0].astype(float) for part in prior.base_jacobian(here.latent[None]))
        sigmas = np.asarray(self.objective.model.manifest.sigmas)
        density, by_latent = prior.log_density(here.latent[None])
        value = point.value - 0.5 * float(np.square(base / sigmas).sum()) - float(density[0])
        gradient = point.gradient.copy()
        gradient[:-7] -= slope.T @ (base / sigmas**2) + by_latent[0]
        gradient[-4:-1] = left_jacobian(step[-4:-1]).T @ gradient[-4:-1]
        return value, self.root.T @ gradient


def left_jacobian(turn: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """``J`` with ``exp(w + d) = exp(J d) exp(w)`` to first order in d (Sola et al. 2018, equation 145)."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-4:
        return np.eye(3) + 0.5 * cross
    first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)


class _Potential(torch.autograd.Function):
    """The posterior for Pyro, which asks torch for gradients."""

    @staticmethod
    def forward(context, whitened, posterior):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN205
        """Value; keeps the gradient."""
        value, gradient = posterior.at(whitened.detach().numpy().astype(float))
        context.save_for_backward(torch.as_tensor(gradient, dtype=whitened.dtype))
        return torch.as_tensor(value, dtype=whitened.dtype)

    @staticmethod
    def backward(context, above):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN205
        """The kept gradient."""
        (gradient,) = context.saved_tensors
        return above * gradient, None


def sampled(posterior: Posterior, seed: int, warm_up: int = WARM_UP, draws: int = DRAWS) -> list[Fit]:
    """Draws of the posterior, one chain from its mode."""
    torch.manual_seed(seed)
    apply = _Potential.apply

    def potential(values: dict[str, torch.Tensor]) -> torch.Tensor:
        answer: torch.Tensor = apply(values["q"], posterior)  # type: ignore[no-untyped-call]
        return answer

    kernel = NUTS(potential_fn=potential, max_tree_depth=DEEPEST, adapt_mass_matrix=False, target_accept_prob=0.8)
    start = {"q": torch.zeros(len(posterior.root), dtype=torch.float64)}
    chain = MCMC(kernel, num_samples=draws, warmup_steps=warm_up, initial_params=start, disable_progbar=True)
    chain.run()
    return [posterior.place(one) for one in chain.get_samples()["q"].numpy()]


def posterior_of(model: ShapeModel, observations: Observations) -> Posterior:
    """The posterior of one drawing, about its fit."""
    options = FitOptions(robust=False)
    found = fit(model, observations, options)
    start: Pose = starting_poses(observations, options)[0]
    objective = Objective(model, observations, start, options)
    return Posterior(objective, found, np.linalg.cholesky(laplace_covariance(found)))


def measure_gold(model: ShapeModel, case: Case, regime: Regime) -> Payload:
    """Laplace and the ensemble of one drawing beside the sampler."""
    drawing = for_evaluation(case.mask, case.grid, regime)
    seen = observe([drawing.stack], drawing.planes, budget=OBSERVATION_BUDGET, seed=0)
    posterior = posterior_of(model, thinned(seen, EVERY, seed=0))
    members = fit_ensemble(model, thinned(seen, EVERY, seed=0), posterior.found, seed=0)
    return compared(model, posterior, sampled(posterior, 0), members)


def compared(model: ShapeModel, posterior: Posterior, draws: list[Fit], members: tuple[Fit, ...]) -> Payload:
    """Movements of the surface by the three methods."""
    found = posterior.found
    mesh: Mesh = surface_of(model, found.latent, found.pose)
    step = max(1, len(mesh.vertices) // VERTICES)
    vertices, areas = mesh.vertices[::step], vertex_areas(mesh)[::step]
    _, by_parameter, by_point = fitted_jacobians(model, found, vertices)
    factors = normal_displacements(by_parameter, by_point) @ posterior.root
    gold, ensemble = (_moves(model, fits, vertices, by_point) for fits in (draws, members))
    laplace_sd, gold_sd, ensemble_sd = np.linalg.norm(factors, axis=1), gold.std(axis=0), ensemble.std(axis=0)
    volumes, volume_sd = gold @ areas, float(np.linalg.norm(areas @ factors))
    return {
        "mean_off_in_sds": float(np.sqrt(np.mean(np.square(gold.mean(axis=0) / gold_sd)))),
        "sd_ratio": {"laplace": _ratio(laplace_sd, gold_sd), "ensemble": _ratio(ensemble_sd, gold_sd)},
        "sd_correlation": {
            "laplace": _correlation(laplace_sd, gold_sd),
            "ensemble": _correlation(ensemble_sd, gold_sd),
        },
        "volume_sd_ratio": volume_sd / float(volumes.std()),
        "inside": {f"{level:g}": _inside(gold, laplace_sd, level) for level in (0.5, 0.9)},
        "draws": len(draws),
    }


def _moves(
    model: ShapeModel, fits: list[Fit] | tuple[Fit, ...], vertices: Float[np.ndarray, "v 3"], by_point: np.ndarray
) -> Float[np.ndarray, "c v"]:
    slope = np.maximum(np.linalg.norm(by_point, axis=1), 1e-6)
    return np.stack([fitted_logits(model, one, vertices) / slope for one in fits])


def _ratio(found: Float[np.ndarray, "v"], gold: Float[np.ndarray, "v"]) -> float:
    return float(np.median(found / gold))


def _correlation(found: Float[np.ndarray, "v"], gold: Float[np.ndarray, "v"]) -> float:
    return float(np.corrcoef(found, gold)[0, 1])


def _inside(gold: Float[np.ndarray, "c v"], sd: Float[np.ndarray, "v"], level: float) -> float:
    """Share of draws within Laplace's interval of each vertex, averaged over vertices."""
    return float(np.mean(np.abs(gold) <= interval_reach(level) * sd))
