"""How far the discrepancy spreads and how sharp logits are: what makes probabilities of voxels right.

A decoder gives one code to a shape, and where codes do not tell whether a voxel is inside, its logits are near zero: by
themselves they are probabilities. What the posterior leaves open comes on top, and much of that doubt is the same one,
counted twice. So logits are multiplied by a factor before probabilities are taken (temperature scaling, Guo et al.,
ICML 2017), which leaves the surface where it is. The factor and the spread of the discrepancy are those of the lowest
cross-entropy of the posterior mean occupancy of validation voxels, a proper score.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from model.bundle import ShapeModel
from model.inference.discrepancy.conditioning import DiscrepancyPrior
from model.inference.posterior import fitted_jacobians, laplace_covariance, mean_probability, open_variance
from model.inference.uncertainty import settled_variance
from training.scored_drawing import ScoredDrawing

#: Spreads (mm) and factors that are tried.
SPREADS_MM = (0.1, 0.2, 0.35, 0.6, 1.0, 1.7)
SHARPNESSES = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0)
#: Probabilities are held this far from certainty, lest one voxel decide.
LEAST_DOUBT = 1e-6


class ProbabilityScale(NamedTuple):
    """What is chosen together: spread of the discrepancy (mm), and factor on logits."""

    spread_mm: float
    sharpness: float


def cross_entropies(model: ShapeModel, drawings: Iterable[ScoredDrawing]) -> dict[ProbabilityScale, float]:
    """Mean cross-entropy (nats) of voxels near the true surface by what is tried, at the model's fidelity."""
    totals: dict[ProbabilityScale, list[float]] = {}
    for drawing in drawings:
        for tried, value in _scores(model, drawing):
            totals.setdefault(tried, []).append(value)
    return {tried: float(np.mean(values)) for tried, values in totals.items()}


def best_scale(found: dict[ProbabilityScale, float]) -> ProbabilityScale:
    """That of the lowest cross-entropy."""
    return min(found, key=found.__getitem__)


def as_facts(found: dict[ProbabilityScale, float]) -> dict[str, object]:
    """Cross-entropies by spread at the best sharpness and the other way round, as text for a manifest."""
    best = best_scale(found)
    return {
        "cross_entropy_by_spread": _named((scale.spread_mm, v) for scale, v in found.items() if scale[1] == best[1]),
        "cross_entropy_by_sharpness": _named((scale.sharpness, v) for scale, v in found.items() if scale[0] == best[0]),
    }


def _named(values: Iterable[tuple[float, float]]) -> dict[str, float]:
    return {f"{tried:g}": value for tried, value in values}


def _scores(model: ShapeModel, drawing: ScoredDrawing) -> Iterator[tuple[ProbabilityScale, float]]:
    """The spread scales the variance of the discrepancy and leaves its mean."""
    fidelity = model.manifest.discrepancy["fidelity"]
    found = drawing.corrected(model, DiscrepancyPrior(1.0, fidelity))
    logits, *derivatives = fitted_jacobians(model, found, drawing.points)
    of_fit = settled_variance(found, laplace_covariance(found), *derivatives)
    of_discrepancy = open_variance(found, drawing.points)
    of_truth = np.where(drawing.truth, logits, -logits)
    for spread in SPREADS_MM:
        variance = of_fit + spread**2 * of_discrepancy
        for sharpness in SHARPNESSES:
            said = mean_probability(of_truth, variance, sharpness).astype(float)
            yield ProbabilityScale(spread, sharpness), float(-np.log(np.maximum(said, LEAST_DOUBT)).mean())
