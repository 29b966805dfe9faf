"""What answers from sound drawings usually say about themselves, measured on validation shapes.

Figures of `model.inference.reliability` and `model.inference.typicality`, over drawings of three planes and more:
largest orthogonal slices, every 8th axial one, and parallel ones across the longest axis. A power of the number of
planes is fitted to each figure; the highest usual value is that line moved up to a high quantile of the drawings, or
where those of a few cases are too few to know it, to the one that Student's prediction of a further case puts there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

from model.bundle import ShapeModel
from model.inference.agreement import sections_of as compared
from model.inference.discrepancy.conditioning import discrepancy_prior
from model.inference.mesh import vertex_areas, volume_ml
from model.inference.observations import observe
from model.inference.posterior import fitted_logits
from model.inference.reconstruction import COVER_SHARE_OF_BAND, OBSERVATION_BUDGET, SURFACE_SD, Options, reconstruct
from model.inference.reliability import MOST_USUAL_PLANES, USUAL_PLANES, Figures, figures_of
from model.inference.typicality import rarity
from model.inference.uncertainty import surface_spread
from training.answerable import answerable, naming
from training.cohorts.cohort import Case
from training.field_of_view import in_view, volume_out_of_view_ml
from training.perturb import Sections, parallel, sections_of
from training.sparsify import Regime, for_evaluation
from training.surface_error import digitisation_mm, distances_to, true_points

#: Share of sound drawings that stay below the highest usual value of one figure.
USUAL_QUANTILE = 0.95
#: Numbers of parallel planes.
PARALLEL = (3, 5, MOST_USUAL_PLANES)
#: SDs (of logarithms, and of cube roots of nats) are not taken for smaller than these, whatever a few shapes show.
LEAST_SD = {"misfit": 0.15, "rarity": 0.15, "slice": 0.2}


@dataclass(frozen=True)
class Sound:
    """An answer to a sound drawing beside the truth.

    Attributes:
        figures: what it says about itself.
        density: log prior density of the code (nats).
        surprises: of each plane, see `model.inference.agreement.Section`.
        surface_error_mm, surface_sd_mm: RMS over vertices: distance from the true surface, less what digitising it
            adds, and posterior SD.
        volume_error_ml, volume_sd_ml: of the volume, the SD by the posterior as it is.
        swelling_ml: how much the volume grows when the whole surface moves out by 1 mm.
    """

    figures: Figures
    density: float
    surprises: tuple[float, ...]
    surface_error_mm: float
    surface_sd_mm: float
    volume_error_ml: float
    volume_sd_ml: float
    swelling_ml: float


def sound_answers(model: ShapeModel, cases: Sequence[Case]) -> list[Sound]:
    """Answers to sound drawings of cases that a model was not trained on."""
    # What was known before is forgotten, lest it change the answers.
    unjudged = replace(model, manifest=replace(model.manifest, usual={}, posterior={}, typical={}))
    return [answered(unjudged, case, name, drawn) for case in cases for name, drawn in sound_drawings(case).items()]


def usual_figures(sound: Sequence[Sound], cases: int) -> dict[str, float]:
    """`Manifest.usual` of a model, from drawings of so many cases."""
    planes = np.array([one.figures.planes for one in sound], float)
    freedom = freedom_of(cases)
    return {
        **_line("misfit", planes, np.array([one.figures.misfit_mm for one in sound]), freedom),
        **_line("surface_sd", planes, np.array([one.figures.surface_sd_mm for one in sound]), freedom),
    }


def freedom_of(cases: int) -> int:
    """Degrees of freedom of figures over sound drawings of so many cases.

    Drawings of one case are much alike: those of two answers a case.
    """
    return max(2 * cases - 1, 3)


def typical_figures(sound: Sequence[Sound], cases: int, peak: float) -> dict[str, float]:
    """`Manifest.typical` of a model, from drawings of so many cases.

    Args:
        peak: log prior density of the mean shape (nats).
    """
    planes = np.array([one.figures.planes for one in sound], float)
    across, misfits = np.log(planes / USUAL_PLANES), _logs(np.array([one.figures.misfit_mm for one in sound]))
    exponent = _exponent(across, misfits)
    samples = {
        "misfit": misfits - exponent * across,
        "rarity": rarity(np.array([one.density for one in sound]), peak),
        "slice": np.concatenate([one.surprises for one in sound]),
    }
    found = {"freedom": float(freedom_of(cases)), "misfit_exponent": round(exponent, 4), "density_peak": round(peak, 4)}
    for name, values in samples.items():
        found[f"{name}_mean"] = round(float(values.mean()), 4)
        found[f"{name}_sd"] = round(max(LEAST_SD[name], float(values.std(ddof=1))), 4)
    return found


def sound_drawings(case: Case) -> dict[str, Sections]:
    """Drawings as they should be, by name; those that show the object on too few planes are left out."""
    regimes: tuple[Regime, ...] = ("orthogonal", "thin")
    drawings = {regime: sections_of(for_evaluation(case.mask, case.grid, regime)) for regime in regimes}
    across = {f"{count} parallel slices": parallel(case.mask, case.grid, count) for count in PARALLEL}
    return answerable({**drawings, **across})


def answered(model: ShapeModel, case: Case, name: str, drawing: Sections) -> Sound:
    """The answer to a drawing of a case, measured.

    Raises:
        CohortError: there is none; names the case and the drawing.
    """
    with naming(case, name):
        answer = reconstruct(model, drawing.stacks, Options(annotated=drawing.planes))
    found, mesh = answer.state.fits[0], answer.mesh
    observations = observe(drawing.stacks, drawing.planes, budget=OBSERVATION_BUDGET, cover=COVER_SHARE_OF_BAND, seed=0)
    figures = figures_of(model, found, drawing.stacks, observations, mesh, discrepancy_prior(model.manifest))
    sections = compared(observations, fitted_logits(model, found, observations.points), found.plane_weights)
    spread, sd = surface_spread(model, answer.state, mesh), mesh.scalars[SURFACE_SD]
    swelling = vertex_areas(mesh) / 1000.0
    seen = in_view(case, mesh.vertices)
    errors = np.square(distances_to(true_points(case.mask, case.grid), mesh.vertices[seen])).mean()
    return Sound(
        figures=figures,
        density=answer.log_prior_density,
        surprises=tuple(section.surprise for section in sections),
        surface_error_mm=float(np.sqrt(max(errors - digitisation_mm(case.grid) ** 2, 0.0))),
        surface_sd_mm=float(np.sqrt(np.square(sd[seen]).mean())),
        volume_error_ml=volume_ml(mesh) - volume_out_of_view_ml(case, mesh) - case.volume_ml,
        volume_sd_ml=0.0 if spread is None else spread.sd_of(swelling),
        swelling_ml=float(swelling.sum()),
    )


def _line(name: str, planes: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"], freedom: int) -> dict[str, float]:
    """Highest usual value at `USUAL_PLANES` and the exponent of the number of planes."""
    across, logs = np.log(planes / USUAL_PLANES), _logs(values)
    exponent = _exponent(across, logs)
    highest = float(np.exp(_upper(logs - exponent * across, freedom)))
    return {f"{name}_mm": round(highest, 4), f"{name}_exponent": round(exponent, 4)}


def _upper(values: Float[np.ndarray, "n"], freedom: int) -> float:
    """What a further value stays below with `USUAL_QUANTILE`: the quantile seen, or the one predicted if higher."""
    seen = float(np.quantile(values, USUAL_QUANTILE))
    if len(values) < 2:
        return seen
    reach = float(student.ppf(USUAL_QUANTILE, freedom)) * np.sqrt(1.0 + 1.0 / (freedom + 1))
    return max(seen, float(values.mean() + reach * values.std(ddof=1)))


def _logs(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    return np.asarray(np.log(np.maximum(values, 1e-6)))


def _exponent(across: Float[np.ndarray, "n"], logs: Float[np.ndarray, "n"]) -> float:
    return float(np.polyfit(across, logs, 1)[0]) if np.ptp(across) > 0 else 0.0
