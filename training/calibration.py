"""How much a drawn mm^2 is worth and how far the slices are followed: chosen on validation shapes.

Neighbouring voxels are not independent, so the sum of their log likelihoods overstates what a slice tells (likelihood
precision), and what the code leaves unexplained at a contour is partly the shape's, partly the annotator's (spread and
fidelity of the discrepancy). Precision and fidelity are those that leave the fewest voxels near the true surface on its
wrong side, the lowest of those that hardly differ; the spread, which moves no surface, is the one with the lowest
cross-entropy of the posterior mean occupancy there, a proper score. With these, answers to sound drawings tell what is
usual and typical for the model (`training.usual`) and how wide its SDs have to be (`training.posterior_scale`).
Of models that have a network to complete drawings, the weight of what it says is chosen by the average surface distance
after that, and the spread once more.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from model.bundle import Manifest, ShapeModel, open_bundle, write_manifest
from model.inference.discrepancy.conditioning import DiscrepancyPrior, corrected, with_discrepancy
from model.inference.fitting import Fit, FitOptions, fit
from model.inference.observations import Observations, observe
from model.inference.posterior import (
    fitted_jacobians,
    laplace_covariance,
    logit_variance,
    mean_probability,
    open_variance,
)
from model.inference.reconstruction import COVER_SHARE_OF_BAND, OBSERVATION_BUDGET
from model.inference.thick_slices import through_thickness
from model.inference.typicality import peak_density
from training.cohorts.cohort import Case, Cohort
from training.config import Regime
from training.evaluate import surface_distance
from training.posterior_scale import posterior_scale
from training.seen import check_unseen
from training.sparsify import Drawing, for_evaluation
from training.usual import sound_answers, typical_figures, usual_figures

#: Precisions that are tried (1/mm^2), fidelities, spreads (mm), and the regimes that they are tried on.
PRECISIONS = (0.1, 0.2, 0.4, 0.8)
FIDELITIES = (0.15, 0.3, 0.5, 0.7, 0.85)
SPREADS_MM = (0.2, 0.35, 0.6, 1.0, 1.7)
#: Weights of a completed drawing beside the fitted surface that are tried, and the one before any was chosen.
SHARES, UNCALIBRATED_SHARE = (0.0, 0.25, 0.5, 0.75), 0.5
REGIMES: tuple[Regime, ...] = ("orthogonal", "thin", "thick")
#: Voxels this close to the true surface are scored (mm), at most so many of a case.
BAND_MM = 5.0
SCORED_VOXELS = 4000
#: Errors that differ by less than this share count as equal: the least precision then gives the quickest fit.
TIE = 0.005
#: Evenly spaced validation cases that are used, those with which completed drawings are weighed, and those whose sound
#: drawings are answered in the end.
CASES, COMPLETED_CASES, JUDGED_CASES = 8, 24, 36

#: Told that one of the stages is done.
Advance = Callable[[], None]


class Candidate(NamedTuple):
    """What is chosen together: precision (1/mm^2), fidelity, and spread (mm)."""

    precision: float
    fidelity: float
    spread_mm: float


class Score(NamedTuple):
    """Means over voxels near the surface: share on its wrong side, and cross-entropy (nats)."""

    error: float
    cross_entropy: float


@dataclass(frozen=True)
class Calibration:
    """Mean score of each candidate."""

    scores: dict[Candidate, Score]

    @property
    def best(self) -> Candidate:
        """Least precision, and then fidelity, among the most accurate, with the most honest spread."""
        limit = (1.0 + TIE) * min(score.error for score in self.scores.values())
        tied = [candidate for candidate, score in self.scores.items() if score.error <= limit]
        pair = min(candidate[:2] for candidate in tied)
        return min((c for c in tied if c[:2] == pair), key=lambda candidate: self.scores[candidate].cross_entropy)

    def errors(self) -> dict[str, float]:
        """Share of voxels on the wrong side by precision and fidelity, as text."""
        return {f"{c.precision:g}, {c.fidelity:g}": score.error for c, score in self.scores.items()}

    def cross_entropies(self) -> dict[str, float]:
        """Cross-entropy by spread at the best precision and fidelity, as text."""
        best = self.best[:2]
        return {f"{c.spread_mm:g}": score.cross_entropy for c, score in self.scores.items() if c[:2] == best}


def calibrate(model: ShapeModel, cases: Sequence[Case], advance: Advance = lambda: None) -> Calibration:
    """Choose for a model on cases that it was not trained on."""
    chosen = cases[:: -(-len(cases) // CASES)]
    totals: dict[Candidate, list[Score]] = {}
    for precision in PRECISIONS:
        trial = with_precision(model, precision)
        for case in chosen:
            for regime in REGIMES:
                for candidate, value in scores(trial, case, regime):
                    totals.setdefault(candidate, []).append(value)
        advance()
    return Calibration({candidate: Score(*np.mean(values, axis=0).tolist()) for candidate, values in totals.items()})


def calibrate_bundle(
    folder: Path, cohort: Cohort, advance: Advance = lambda: None, *, threads: int | None = None
) -> Calibration:
    """Calibrate a bundle on a cohort's validation cases and record the result in its manifest.

    Figures that were measured before are of another model and are taken out (`Manifest.accuracy`).

    Raises:
        BundleError: the bundle cannot be trusted.
        InvalidParameter: the model was trained on one of the cases.
    """
    model = uncalibrated_share(open_bundle(folder, threads=threads))
    check_unseen(model.manifest, cohort.validation)
    found = calibrate(model, cohort.validation, advance)
    facts: dict[str, object] = {
        "cohort": cohort.name,
        "split": "validation",
        "cases": [case.name for case in cohort.validation[:: -(-len(cohort.validation) // CASES)]],
        "regimes": list(REGIMES),
        "error_by_precision_and_fidelity": found.errors(),
        "cross_entropy_by_spread": found.cross_entropies(),
    }
    discrepancy = {"spread_mm": found.best.spread_mm, "fidelity": found.best.fidelity}
    # What was measured before does not hold any more.
    changed = replace(
        model.manifest,
        likelihood_precision=found.best.precision,
        discrepancy=discrepancy,
        calibration=facts,
        accuracy={},
    )
    if model.completer is not None:
        changed = with_share(replace(model, manifest=changed), cohort.validation, advance)
        changed = with_spread(replace(model, manifest=changed), cohort.validation)
    write_manifest(with_sound_drawings(replace(model, manifest=changed), cohort.validation, advance), folder)
    return found


def stages(manifest: Manifest) -> int:
    """How often calibrating a bundle tells its watcher that it has come further."""
    return len(PRECISIONS) + (len(SHARES) if manifest.completion else 0) + 1


def counting(model: ShapeModel, share: float) -> ShapeModel:
    """The model with another weight of completed drawings."""
    return replace(model, manifest=replace(model.manifest, completion={**model.manifest.completion, "share": share}))


def uncalibrated_share(model: ShapeModel) -> ShapeModel:
    """The model as it was before a weight of completed drawings was chosen; itself without such a network."""
    return model if model.completer is None else counting(model, UNCALIBRATED_SHARE)


def with_share(model: ShapeModel, cases: Sequence[Case], advance: Advance = lambda: None) -> Manifest:
    """The manifest with the least weight of completed drawings that brings surfaces nearest to the masks."""
    chosen = cases[:: -(-len(cases) // COMPLETED_CASES)]
    distances: dict[float, float] = {}
    for share in SHARES:
        trial = counting(model, share)
        distances[share] = float(
            np.mean([surface_distance(trial, case, regime) for case in chosen for regime in REGIMES])
        )
        advance()
    best = min(share for share in SHARES if distances[share] <= (1.0 + TIE) * min(distances.values()))
    facts = {**model.manifest.calibration, "asd_mm_by_share": {f"{share:g}": mm for share, mm in distances.items()}}
    return replace(counting(model, best).manifest, calibration=facts)


def with_spread(model: ShapeModel, cases: Sequence[Case]) -> Manifest:
    """The manifest with the spread of lowest cross-entropy where all else is given."""
    fidelity = model.manifest.discrepancy["fidelity"]
    totals: dict[float, list[float]] = {}
    for case in cases[:: -(-len(cases) // CASES)]:
        for regime in REGIMES:
            seen = _fitted(model, case, regime)
            following = seen.corrected(model, DiscrepancyPrior(1.0, fidelity))
            for spread, score in _scores_of(model, following, seen.points, seen.truth):
                totals.setdefault(spread, []).append(score.cross_entropy)
    means = {spread: float(np.mean(values)) for spread, values in totals.items()}
    best = min(means, key=means.__getitem__)
    facts = {**model.manifest.calibration, "cross_entropy_by_spread": {f"{s:g}": value for s, value in means.items()}}
    return replace(model.manifest, discrepancy={**model.manifest.discrepancy, "spread_mm": best}, calibration=facts)


def calibrate_bundle_as(folder: Path, known: Manifest, cohort: Cohort, *, threads: int | None = None) -> None:
    """Let a bundle trust drawings as much as another calibrated one does; how its own answers look is found out anew.

    For models of one training that differ in their prior: which precision and fidelity come out best is often chance,
    and would stand for a difference between the priors. Figures that were measured before are taken out.

    Args:
        known: of the other bundle.

    Raises:
        BundleError: the bundle cannot be trusted.
    """
    model = open_bundle(folder, threads=threads)
    changed = replace(
        model.manifest,
        likelihood_precision=known.likelihood_precision,
        discrepancy=known.discrepancy,
        calibration=known.calibration,
        accuracy={},
    )
    write_manifest(with_sound_drawings(replace(model, manifest=changed), cohort.validation), folder)


def with_sound_drawings(model: ShapeModel, cases: Sequence[Case], advance: Advance = lambda: None) -> Manifest:
    """The manifest with what answers to sound drawings of validation cases show: usual, typical, width of SDs."""
    chosen = cases[:: -(-len(cases) // JUDGED_CASES)]
    sound = sound_answers(model, chosen)
    advance()
    facts = {**model.manifest.calibration, "sound_drawings": len(sound), "sound_cases": len(chosen)}
    return replace(
        model.manifest,
        calibration=facts,
        usual=usual_figures(sound, len(chosen)),
        typical=typical_figures(sound, len(chosen), peak_density(model)),
        posterior=posterior_scale(sound),
    )


def with_precision(model: ShapeModel, precision: float) -> ShapeModel:
    """The model with another likelihood precision (1/mm^2)."""
    return replace(model, manifest=replace(model.manifest, likelihood_precision=precision))


def scores(model: ShapeModel, case: Case, regime: Regime) -> Iterator[tuple[Candidate, Score]]:
    """Score of each candidate on one drawing."""
    seen = _fitted(model, case, regime)
    for fidelity in FIDELITIES:
        following = seen.corrected(model, DiscrepancyPrior(1.0, fidelity))
        for spread, value in _scores_of(model, following, seen.points, seen.truth):
            yield Candidate(model.manifest.likelihood_precision, fidelity, spread), value


@dataclass(frozen=True)
class _Fitted:
    """A fit to one drawing of a case with its discrepancy, and voxels (world mm) near the true surface with labels."""

    drawing: Drawing
    observations: Observations
    found: Fit
    points: Float[np.ndarray, "n 3"]
    truth: Bool[np.ndarray, "n"]

    def corrected(self, model: ShapeModel, prior: DiscrepancyPrior) -> Fit:
        """The fit with its discrepancy under another prior."""
        return corrected(model, self.found, [self.drawing.stack], self.observations, prior)


def _fitted(model: ShapeModel, case: Case, regime: Regime) -> _Fitted:
    drawing = for_evaluation(case.mask, case.grid, regime)
    observations = observe(
        [drawing.stack], drawing.planes, budget=OBSERVATION_BUDGET, cover=COVER_SHARE_OF_BAND, seed=0
    )
    options = FitOptions(robust=False)
    fitted = fit(model, observations, options)
    found, _ = through_thickness(model, fitted, [drawing.stack], observations, options)
    found = with_discrepancy(model, found, [drawing.stack], observations, DiscrepancyPrior())
    index = np.argwhere(near_surface(case.mask, case.grid.spacing))
    index = index[:: -(-len(index) // SCORED_VOXELS)]
    points, truth = case.grid.to_world(index.astype(float)), case.mask[tuple(index.T)]
    return _Fitted(drawing, observations, found, points, truth)


def _scores_of(
    model: ShapeModel, found: Fit, points: Float[np.ndarray, "n 3"], truth: Bool[np.ndarray, "n"]
) -> Iterator[tuple[float, Score]]:
    """Scores by spread: it scales the discrepancy's variance and leaves its mean."""
    logits, by_parameter, _ = fitted_jacobians(model, found, points)
    of_parameters = logit_variance(by_parameter, laplace_covariance(found))
    of_discrepancy = open_variance(found, points)
    error = float(np.mean((logits > 0) != truth))
    for spread in SPREADS_MM:
        probability = mean_probability(logits, of_parameters + spread**2 * of_discrepancy).astype(float)
        probability = np.clip(probability, 1e-6, 1.0 - 1e-6)
        cross_entropy = -np.mean(np.where(truth, np.log(probability), np.log1p(-probability)))
        yield spread, Score(error, float(cross_entropy))


def near_surface(mask: Bool[np.ndarray, "i j k"], spacing: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "i j k"]:
    """Voxels within `BAND_MM` of the surface of a mask."""
    inside, outside = distance_transform_edt(mask, spacing), distance_transform_edt(~mask, spacing)
    return np.asarray(np.where(mask, inside, outside) <= BAND_MM)
