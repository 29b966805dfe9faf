"""What answers from sound drawings usually say about themselves, measured on validation shapes.

Figures of `model.inference.reliability`, over drawings of three planes and more: largest orthogonal slices, every 8th
axial one, and parallel ones across the longest axis. A power of the number of planes is fitted to each figure; the
highest usual value is that line moved up to a high quantile of the drawings.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.inference.discrepancy.conditioning import discrepancy_prior
from model.inference.observations import observe
from model.inference.reconstruction import OBSERVATION_BUDGET, Options, reconstruct
from model.inference.reliability import USUAL_PLANES, Figures, figures_of
from training.cohorts.cohort import Case
from training.perturb import Sections, parallel, sections_of
from training.sparsify import for_evaluation

#: Share of sound drawings that stay below the highest usual value of one figure.
USUAL_QUANTILE = 0.95
#: Numbers of parallel planes.
PARALLEL = (3, 5, 8)


def usual_figures(model: ShapeModel, cases: Sequence[Case]) -> dict[str, float]:
    """`Manifest.usual` of a model, from cases that it was not trained on."""
    # What was usual before is forgotten, lest it change the fits.
    unjudged = replace(model, manifest=replace(model.manifest, usual={}))
    found = [measured(unjudged, drawing) for case in cases for drawing in sound_drawings(case)]
    planes = np.array([one.planes for one in found], float)
    return {
        **_line("misfit", planes, np.array([one.misfit_mm for one in found])),
        **_line("surface_sd", planes, np.array([one.surface_sd_mm for one in found])),
    }


def sound_drawings(case: Case) -> Iterator[Sections]:
    """Drawings as they should be."""
    yield sections_of(for_evaluation(case.mask, case.grid, "orthogonal"))
    yield sections_of(for_evaluation(case.mask, case.grid, "thin"))
    for count in PARALLEL:
        yield parallel(case.mask, case.grid, count)


def measured(model: ShapeModel, drawing: Sections) -> Figures:
    """Figures of the answer to a drawing."""
    answer = reconstruct(model, drawing.stacks, Options(annotated=drawing.planes, uncertainty="none"))
    observations = observe(drawing.stacks, drawing.planes, budget=OBSERVATION_BUDGET, seed=0)
    prior = discrepancy_prior(model.manifest)
    return figures_of(model, answer.state.fits[0], drawing.stacks, observations, answer.mesh, prior)


def _line(name: str, planes: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"]) -> dict[str, float]:
    """Highest usual value at `USUAL_PLANES` and the exponent of the number of planes."""
    across, logs = np.log(planes / USUAL_PLANES), np.log(np.maximum(values, 1e-6))
    exponent = float(np.polyfit(across, logs, 1)[0]) if np.ptp(across) > 0 else 0.0
    highest = float(np.exp(np.quantile(logs - exponent * across, USUAL_QUANTILE)))
    return {f"{name}_mm": round(highest, 4), f"{name}_exponent": round(exponent, 4)}
