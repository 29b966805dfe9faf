"""How much a drawn mm^2 is worth: the likelihood precision, chosen on validation shapes.

Neighbouring voxels are not independent, so the sum of their log likelihoods overstates what a slice tells. Each
candidate is judged by the cross-entropy of the posterior mean occupancy on voxels near the true surface: a proper
score, lowest where the fit is accurate and its uncertainty honest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from model.bundle import ShapeModel, open_bundle, write_manifest
from model.inference.fitting import FitOptions, fit
from model.inference.observations import observe
from model.inference.posterior import fitted_jacobians, laplace_covariance, logit_variance, mean_probability
from model.inference.reconstruction import OBSERVATION_BUDGET
from training.cohorts.cohort import Case, Cohort
from training.config import Regime
from training.sparsify import for_evaluation

#: Precisions that are tried (1/mm^2), and the regimes that they are tried on.
CANDIDATES = (0.025, 0.05, 0.1, 0.2, 0.4, 0.8)
REGIMES: tuple[Regime, ...] = ("orthogonal", "thin", "thick")
#: Voxels this close to the true surface are scored (mm).
BAND_MM = 5.0

Watch = Callable[[float], None]


@dataclass(frozen=True)
class Calibration:
    """Scores of the candidates and the best of them.

    Attributes:
        precision: the chosen likelihood precision (1/mm^2).
        scores: mean cross-entropy (nats a voxel) of each candidate.
    """

    precision: float
    scores: dict[float, float]


def calibrate(model: ShapeModel, cases: Sequence[Case], watch: Watch = lambda precision: None) -> Calibration:
    """Choose the likelihood precision of a model on cases that it was not trained on."""
    scores = {}
    for precision in CANDIDATES:
        trial = with_precision(model, precision)
        scores[precision] = float(np.mean([score(trial, case, regime) for case in cases for regime in REGIMES]))
        watch(precision)
    return Calibration(min(scores, key=scores.__getitem__), scores)


def calibrate_bundle(folder: Path, cohort: Cohort, watch: Watch = lambda precision: None) -> Calibration:
    """Calibrate a bundle on a cohort's validation cases and record the result in its manifest.

    Raises:
        BundleError: the bundle cannot be trusted.
    """
    model = open_bundle(folder)
    found = calibrate(model, cohort.validation, watch)
    facts: dict[str, object] = {
        "cohort": cohort.name,
        "split": "validation",
        "cases": [case.name for case in cohort.validation],
        "regimes": list(REGIMES),
        "cross_entropy": {f"{precision:g}": value for precision, value in found.scores.items()},
    }
    write_manifest(replace(model.manifest, likelihood_precision=found.precision, calibration=facts), folder)
    return found


def with_precision(model: ShapeModel, precision: float) -> ShapeModel:
    """The model with another likelihood precision (1/mm^2)."""
    return replace(model, manifest=replace(model.manifest, likelihood_precision=precision))


def score(model: ShapeModel, case: Case, regime: Regime) -> float:
    """Cross-entropy (nats a voxel) of the posterior mean occupancy near the true surface."""
    drawing = for_evaluation(case.mask, case.grid, regime)
    observations = observe([drawing.stack], drawing.planes, budget=OBSERVATION_BUDGET, seed=0)
    found = fit(model, observations, FitOptions())
    near = near_surface(case.mask, case.grid.spacing)
    points = case.grid.to_world(np.argwhere(near).astype(float))
    logits, by_parameter, _ = fitted_jacobians(model, found, points)
    probability = mean_probability(logits, logit_variance(by_parameter, laplace_covariance(found)))
    probability = np.clip(probability.astype(float), 1e-6, 1.0 - 1e-6)
    return float(-np.mean(np.where(case.mask[near], np.log(probability), np.log1p(-probability))))


def near_surface(mask: Bool[np.ndarray, "i j k"], spacing: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "i j k"]:
    """Voxels within `BAND_MM` of the surface of a mask."""
    inside, outside = distance_transform_edt(mask, spacing), distance_transform_edt(~mask, spacing)
    return np.asarray(np.where(mask, inside, outside) <= BAND_MM)
