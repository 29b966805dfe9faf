"""How much a drawn mm^2 is worth: the likelihood precision, chosen on validation shapes.

Neighbouring voxels are not independent, so the sum of their log likelihoods overstates what a slice tells. Each candidate
precision is judged by the cross-entropy of the posterior mean occupancy on voxels that were not drawn, near the true
surface: a proper score, lowest where the fit is accurate and its uncertainty honest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from model.bundle import ShapeModel, open_bundle, write_manifest
from model.inference.reconstruction import Options, reconstruct
from model.inference.uncertainty import occupancy
from training.cohorts.cohort import Case, Cohort
from training.config import Regime
from training.sparsify import for_evaluation

#: Precisions that are tried (1/mm^2), and the regimes that they are tried on.
CANDIDATES = (0.025, 0.05, 0.1, 0.2, 0.4, 0.8)
REGIMES: tuple[Regime, ...] = ("orthogonal", "thin")
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
    found = reconstruct(model, [drawing.stack], Options(annotated=drawing.planes, uncertainty="laplace"))
    near = near_surface(case.mask, case.grid.spacing)
    probability = np.clip(occupancy(model, found.state, case.grid)[near].astype(float), 1e-6, 1.0 - 1e-6)
    return float(-np.mean(np.where(case.mask[near], np.log(probability), np.log1p(-probability))))


def near_surface(mask: Bool[np.ndarray, "i j k"], spacing: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "i j k"]:
    """Voxels within `BAND_MM` of the surface of a mask."""
    inside, outside = distance_transform_edt(mask, spacing), distance_transform_edt(~mask, spacing)
    return np.asarray(np.where(mask, inside, outside) <= BAND_MM)
