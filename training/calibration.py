"""How much a drawn mm^2 is worth and how far the slices are followed: chosen on validation shapes.

Neighbouring voxels are not independent, so the sum of their log likelihoods overstates what a slice tells (likelihood
precision), and what the code leaves unexplained at a contour is partly the shape's, partly the annotator's (fidelity of
the discrepancy). Both are those that leave the fewest voxels near the true surface on its wrong side, the lowest of
those that hardly differ. Of models that have a network to complete drawings, the weight of what it says is chosen by
the average surface distance after that. With these, how far the discrepancy spreads and how sharp logits are
(`training.probability_scale`) make probabilities right, and answers to sound drawings tell what is usual and typical
for the model (`training.usual`) and how wide its SDs have to be (`training.posterior_scale`).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from model.bundle import Manifest, ShapeModel, open_bundle, write_manifest
from model.inference.discrepancy.conditioning import DiscrepancyPrior
from model.inference.posterior import fitted_logits
from model.inference.typicality import peak_density
from model.inference.uncertainty import sharpness_of
from training.answerable import answerable_cases, answerable_drawings, naming
from training.cohorts.cohort import Case, Cohort, evenly
from training.config import Regime
from training.evaluate import reconstruction_error_mm
from training.oblique import SliceStacks
from training.posterior_scale import posterior_scale
from training.probability_scale import as_facts, best_scale, cross_entropies
from training.scored_drawing import ScoredDrawing, scored_drawing
from training.seen import check_unseen, short_digest
from training.usual import sound_answers, typical_figures, usual_figures

#: Precisions that are tried (1/mm^2), fidelities, and the regimes that they are tried on.
PRECISIONS = (0.1, 0.2, 0.4, 0.8)
FIDELITIES = (0.15, 0.3, 0.5, 0.7, 0.85)
#: Weights of a completed drawing beside the fitted surface that are tried, and the one before any was chosen.
SHARES, UNCALIBRATED_SHARE = (0.0, 0.25, 0.5, 0.75), 0.5
REGIMES: tuple[Regime, ...] = ("orthogonal", "thin", "thick")
#: Errors that differ by less than this share count as equal: the least precision then gives the quickest fit.
TIE = 0.005
#: Evenly spaced validation cases by which precision and fidelity are chosen, those by which the weight of completed
#: drawings and the scale of probabilities are, and those whose sound drawings are answered in the end.
CASES, WEIGHED_CASES, JUDGED_CASES = 8, 24, 36

#: Told that one of the stages is done.
Advance = Callable[[], None]


class Trust(NamedTuple):
    """What is chosen together: precision (1/mm^2) and fidelity."""

    precision: float
    fidelity: float


@dataclass(frozen=True)
class Calibration:
    """Mean share of voxels near the surface that lie on its wrong side, by what was tried."""

    errors: dict[Trust, float]

    @property
    def best(self) -> Trust:
        """Least precision, and then fidelity, among the most accurate."""
        limit = (1.0 + TIE) * min(self.errors.values())
        return min(trust for trust, error in self.errors.items() if error <= limit)

    def as_facts(self) -> dict[str, float]:
        """The shares, as text for a manifest."""
        return {f"{trust.precision:g}, {trust.fidelity:g}": error for trust, error in self.errors.items()}


def calibrate(model: ShapeModel, cases: Sequence[Case], advance: Advance = lambda: None) -> Calibration:
    """Choose for a model on cases that it was not trained on."""
    chosen = answerable_cases(evenly(cases, CASES), REGIMES)
    totals: dict[Trust, list[float]] = {}
    for precision in PRECISIONS:
        trial = with_precision(model, precision)
        for case in chosen:
            for name, drawing in drawings_of(case).items():
                with naming(case, name):
                    for trust, error in _errors(trial, case, drawing):
                        totals.setdefault(trust, []).append(error)
        advance()
    return Calibration({trust: float(np.mean(values)) for trust, values in totals.items()})


def drawings_of(case: Case) -> dict[Regime, SliceStacks]:
    """The drawings of a case that a model is calibrated on, by regime."""
    return answerable_drawings(case, REGIMES)


def calibrate_bundle(
    folder: Path, cohort: Cohort, advance: Advance = lambda: None, *, threads: int | None = None
) -> Calibration:
    """Calibrate a bundle on a cohort's validation cases and record the result in its manifest.

    Figures that were measured before are of another model and are taken out (`Manifest.accuracy`).

    Raises:
        BundleError: the bundle cannot be trusted.
        InvalidParameter: the model was trained on one of the cases.
        CohortError: a drawing of a case cannot be reconstructed, or none shows enough.
    """
    model = uncalibrated_share(open_bundle(folder, threads=threads))
    check_unseen(model.manifest, cohort.validation)
    found = calibrate(model, cohort.validation, advance)
    facts: dict[str, object] = {
        "cohort": cohort.name,
        "split": "validation",
        "cases": [case.name for case in evenly(cohort.validation, CASES)],
        "masks": [short_digest(case) for case in cohort.validation],
        "regimes": list(REGIMES),
        "error_by_precision_and_fidelity": found.as_facts(),
    }
    # What was measured before does not hold any more.
    model = changed(
        model,
        likelihood_precision=found.best.precision,
        discrepancy={"spread_mm": DiscrepancyPrior().spread_mm, "fidelity": found.best.fidelity},
        calibration=facts,
        accuracy={},
    )
    if model.completer is not None:
        model = with_share(model, cohort.validation, advance)
    model = with_probability_scale(model, cohort.validation)
    advance()
    write_manifest(with_sound_drawings(model, cohort.validation, advance).manifest, folder)
    return found


def stages(manifest: Manifest) -> int:
    """How often calibrating a bundle tells its watcher that it has come further."""
    return len(PRECISIONS) + (len(SHARES) if manifest.completion else 0) + 2


def changed(model: ShapeModel, **values: Any) -> ShapeModel:
    """The model with other values in its manifest, by the names of `Manifest`."""
    return replace(model, manifest=replace(model.manifest, **values))


def counting(model: ShapeModel, share: float) -> ShapeModel:
    """The model with another weight of completed drawings."""
    return changed(model, completion={**model.manifest.completion, "share": share})


def uncalibrated_share(model: ShapeModel) -> ShapeModel:
    """The model as it was before a weight of completed drawings was chosen; itself without such a network."""
    return model if model.completer is None else counting(model, UNCALIBRATED_SHARE)


def with_share(model: ShapeModel, cases: Sequence[Case], advance: Advance = lambda: None) -> ShapeModel:
    """The model with the weight of completed drawings that brings surfaces nearest to the masks."""
    chosen = answerable_cases(evenly(cases, WEIGHED_CASES), REGIMES)
    distances: dict[float, float] = {}
    for share in SHARES:
        trial = counting(model, share)
        distances[share] = float(
            np.mean([reconstruction_error_mm(trial, case, regime) for case in chosen for regime in drawings_of(case)])
        )
        advance()
    best = min(distances, key=lambda share: distances[share])
    facts = {"asd_mm_by_share": {f"{share:g}": mm for share, mm in distances.items()}}
    return changed(counting(model, best), calibration={**model.manifest.calibration, **facts})


def with_probability_scale(model: ShapeModel, cases: Sequence[Case]) -> ShapeModel:
    """The model with the spread of its discrepancy and the sharpness that make probabilities right, all else given."""
    chosen = answerable_cases(evenly(cases, WEIGHED_CASES), REGIMES)
    found = cross_entropies(model, _scored(model, chosen))
    best = best_scale(found)
    return changed(
        model,
        discrepancy={**model.manifest.discrepancy, "spread_mm": best.spread_mm},
        posterior={**model.manifest.posterior, "sharpness": best.sharpness},
        calibration={**model.manifest.calibration, **as_facts(found)},
    )


def calibrate_bundle_as(folder: Path, known: Manifest, cohort: Cohort, *, threads: int | None = None) -> None:
    """Let a bundle trust drawings as much as another calibrated one does; how its own answers look is found out anew.

    For models of one training that differ in their prior: which precision and fidelity come out best is often chance,
    and would stand for a difference between the priors. Figures that were measured before are taken out.

    Args:
        known: of the other bundle.

    Raises:
        BundleError: the bundle cannot be trusted.
    """
    model = changed(
        open_bundle(folder, threads=threads),
        likelihood_precision=known.likelihood_precision,
        discrepancy=known.discrepancy,
        posterior=known.posterior,
        calibration=known.calibration,
        accuracy={},
    )
    write_manifest(with_sound_drawings(model, cohort.validation).manifest, folder)


def with_sound_drawings(model: ShapeModel, cases: Sequence[Case], advance: Advance = lambda: None) -> ShapeModel:
    """The model with what answers to sound drawings of validation cases show: usual, typical, width of SDs."""
    chosen = evenly(cases, JUDGED_CASES)
    sound = sound_answers(model, chosen)
    advance()
    return changed(
        model,
        calibration={**model.manifest.calibration, "sound_drawings": len(sound), "sound_cases": len(chosen)},
        usual=usual_figures(sound, len(chosen)),
        typical=typical_figures(sound, len(chosen), peak_density(model)),
        posterior={**posterior_scale(sound), "sharpness": sharpness_of(model)},
    )


def with_precision(model: ShapeModel, precision: float) -> ShapeModel:
    """The model with another likelihood precision (1/mm^2)."""
    return changed(model, likelihood_precision=precision)


def _scored(model: ShapeModel, cases: Sequence[Case]) -> Iterator[ScoredDrawing]:
    for case in cases:
        for name, drawing in drawings_of(case).items():
            with naming(case, name):
                found = scored_drawing(model, case, drawing)
            yield found


def _errors(model: ShapeModel, case: Case, drawn: SliceStacks) -> Iterator[tuple[Trust, float]]:
    """Share of voxels near the surface on its wrong side, of one drawing at the model's precision by fidelity."""
    drawing = scored_drawing(model, case, drawn)
    for fidelity in FIDELITIES:
        found = drawing.corrected(model, DiscrepancyPrior(1.0, fidelity))
        inside = fitted_logits(model, found, drawing.points) > 0
        yield Trust(model.manifest.likelihood_precision, fidelity), float(np.mean(inside != drawing.truth))
