"""One answer beside the truth: intervals, voxels, vertices and time, by Laplace and by the ensemble.

The ensemble is that of the service, whose spread has what the contours leave open in it. The scatter of its refits
alone, which the MorphoFlow paper takes for the uncertainty, stands beside it for vertices (``refits``).
"""

import time
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from benchmarks.uncertainty.cells import Payload
from model.bundle import ShapeModel
from model.inference.estimates import estimate_of
from model.inference.member_moves import member_moves
from model.inference.mesh import Mesh, vertex_areas, volume_ml
from model.inference.one_body import body_probability
from model.inference.reconstruction import Options, Reconstruction, UncertaintyRule, reconstruct
from model.inference.uncertainty import ShapeState, surface_spread
from training.cohorts.cohort import Case
from training.field_of_view import in_view, volume_out_of_view_ml
from training.scored_drawing import near_surface
from training.sparsify import Drawing, Regime, for_evaluation
from training.surface_error import anti_aliased_points, distances_to, true_points

#: Levels of the intervals that are checked.
LEVELS = (0.5, 0.9)
#: Bins of the reliability diagram.
BINS = 10
#: Vertices of a case that are kept.
KEPT_VERTICES = 400


def measure_answer(model: ShapeModel, case: Case, regime: Regime) -> Payload:
    """Figures of one case drawn in one way."""
    drawing = for_evaluation(case.mask, case.grid, regime)
    plain, laplace, ensemble = (_timed(model, drawing, rule) for rule in ("none", "laplace", "ensemble"))
    answer = laplace[0]
    seen = _part_in_view(answer.mesh, case)
    errors = distances_to(true_points(case.mask, case.grid), seen.vertices)
    smooth = distances_to(anti_aliased_points(case.mask, case.grid), seen.vertices)
    return {
        "volume": _volume(model, answer, case),
        "ensemble_volume": _volume(model, ensemble[0], case),
        "voxels": {"laplace": _voxels(model, answer, case), "ensemble": _voxels(model, ensemble[0], case)},
        "vertices": _vertices(model, seen, answer.state, ensemble[0].state, errors, smooth),
        "seconds": {
            "fit": laplace[1]["fit"],
            "laplace": laplace[1]["uncertainty"] - plain[1]["uncertainty"],
            "ensemble": ensemble[1]["uncertainty"] - plain[1]["uncertainty"],
        },
        "typicality_percentile": answer.typicality_percentile,
        "warnings": list(answer.warnings),
    }


def _part_in_view(mesh: Mesh, case: Case) -> Mesh:
    """The vertices that the mask can judge, without faces."""
    seen = in_view(case, mesh.vertices)
    return replace(mesh, vertices=mesh.vertices[seen], normals=mesh.normals[seen], faces=mesh.faces[:0], scalars={})


def _timed(model: ShapeModel, drawing: Drawing, rule: UncertaintyRule) -> tuple[Reconstruction, dict[str, float]]:
    """The answer, and processor time (s) of each stage."""
    begun: list[tuple[str, float]] = []
    watch: Callable[[str], None] = lambda stage: begun.append((stage, time.process_time()))  # noqa: E731
    answer = reconstruct(model, [drawing.stack], Options(annotated=drawing.planes, uncertainty=rule), watch)
    begun.append(("end", time.process_time()))
    stages = pairwise(begun)
    return answer, {name: after - before for (name, before), (_, after) in stages}


def _volume(model: ShapeModel, answer: Reconstruction, case: Case) -> Payload:
    slope, spread = vertex_areas(answer.mesh) / 1000.0, surface_spread(model, answer.state, answer.mesh)
    truth = case.volume_ml + volume_out_of_view_ml(case, answer.mesh)
    value = volume_ml(answer.mesh)
    held = {}
    for level in LEVELS:
        estimate = estimate_of(value, slope, spread, level)
        held[f"{level:g}"] = bool((estimate.low or 0.0) <= truth <= (estimate.high or 0.0))
    return {"value_ml": value, "truth_ml": truth, "sd_ml": spread.sd_of(slope) if spread else 0.0, "held": held}


def _voxels(model: ShapeModel, answer: Reconstruction, case: Case) -> Payload:
    """Reliability of voxels within 5 mm of the true surface, in bins of equal width."""
    near = near_surface(case.mask, case.grid.spacing)
    probability = body_probability(model, answer.state, answer.mesh, case.grid)[near].astype(float)
    return reliability(probability, case.mask[near])


def reliability(probability: Float[np.ndarray, "n"], truth: Bool[np.ndarray, "n"]) -> Payload:
    """Number, sum of probabilities and number of true ones in each bin."""
    bins = np.minimum((probability * BINS).astype(int), BINS - 1)
    sums = [np.bincount(bins, weights, BINS).tolist() for weights in (None, probability, truth.astype(float))]
    return {"count": sums[0], "expected": sums[1], "found": sums[2]}


def _vertices(
    model: ShapeModel,
    mesh: Mesh,
    laplace: ShapeState,
    ensemble: ShapeState,
    errors: Float[np.ndarray, "v"],
    smooth: Float[np.ndarray, "v"],
) -> Payload:
    step = max(1, len(errors) // KEPT_VERTICES)
    few = replace(mesh, vertices=mesh.vertices[::step], normals=mesh.normals[::step])
    found = {"error_mm": errors[::step].round(4).tolist(), "smooth_error_mm": smooth[::step].round(4).tolist()}
    for name, state in (("laplace", laplace), ("ensemble", ensemble)):
        spread = surface_spread(model, state, few)
        found[name] = [] if spread is None else spread.sd().round(4).tolist()
    moves = member_moves(model, ensemble.fits[0], ensemble.members, few)
    return {**found, "refits": moves.std(axis=1, ddof=1).round(4).tolist()}
