"""``python -m benchmarks.wrong_slices``: how well a wrong slice can be told at all, given the others and the model.

Of five parallel slices each in turn is left out, the model is fitted to the other four, and the contour of the fifth is
held against what they predict for it: its distances from the fitted surface, with their whole covariance by code, pose,
discrepancy and noise (squared Mahalanobis distance by the number of points). The largest of the five is the drawing's.
It costs five fits and is as much as the model knows, so it bounds what any cheaper test can find.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Float

from model.bundle import ShapeModel, open_bundle
from model.inference.discrepancy.conditioning import discrepancy_prior, with_discrepancy
from model.inference.discrepancy.contours import contour_points
from model.inference.discrepancy.levels import saturated
from model.inference.fit_types import Fit, FitOptions
from model.inference.fitting import fit, refit
from model.inference.observations import Observations, observe
from model.inference.posterior import fitted_jacobians, laplace_covariance, normal_displacements
from model.inference.reconstruction import COVER_SHARE_OF_BAND, OBSERVATION_BUDGET
from training.cohort_options import DataOption
from training.cohorts import CohortName, CohortOptions, data_folder, load_cohort
from training.cohorts.cohort import Case
from training.console import exit_status
from training.evaluate import find_bundle, shipped_bundles
from training.perturb import WRONG_KINDS, Sections, WrongKind, parallel, with_wrong

OPTIONS = FitOptions(robust=False)
#: One contour point in so many is judged.
EVERY = 2
#: Sound drawings that may lie above the limit.
FALSE_ALARMS = 0.05


def surprise(model: ShapeModel, drawing: Sections) -> float:
    """The largest distance of a contour from what the other planes predict for it."""
    observations = observe(drawing.stacks, drawing.planes, budget=OBSERVATION_BUDGET, cover=COVER_SHARE_OF_BAND, seed=0)
    whole = fit(model, observations, OPTIONS)
    return max(_surprises(model, drawing, observations, whole))


def _surprises(model: ShapeModel, drawing: Sections, observations: Observations, whole: Fit) -> Iterator[float]:
    points, plane_of = contour_points(drawing.stacks, observations.planes)
    for number in np.unique(plane_of):
        trust = np.ones(len(observations.planes))
        trust[number] = 0.0
        rest = refit(model, observations, replace(whole, plane_weights=trust), OPTIONS)
        rest = with_discrepancy(model, rest, drawing.stacks, observations, discrepancy_prior(model.manifest))
        yield distance(model, rest, points[plane_of == number][::EVERY])


def distance(model: ShapeModel, found: Fit, points: Float[np.ndarray, "n 3"]) -> float:
    """Squared Mahalanobis distance, by point, of contour points (world mm) from a surface that has not seen them."""
    logits, by_parameter, by_point = fitted_jacobians(model, found, points)
    gaps = normal_displacements(logits[:, None], by_point)[:, 0]
    moves = normal_displacements(by_parameter, by_point)
    covariance = moves @ laplace_covariance(found) @ moves.T
    if found.discrepancy is not None:
        canonical, process = found.pose.to_canonical(points), found.discrepancy
        seen = process.whitened(canonical)
        covariance += process.covariance.between(canonical, canonical) - seen.T @ seen
        covariance += process.noise_mm**2 * np.eye(len(points))
    gaps = saturated(gaps)
    return float(gaps @ np.linalg.solve(covariance, gaps)) / len(points)


def main(
    model: Annotated[str, typer.Option(help="Name of a shipped model, or the folder of a bundle.")] = "hippocampus",
    cohort: Annotated[CohortName, typer.Option(help="Cohort of the model.")] = CohortName.HIPPOCAMPUS,
    data: DataOption = None,
    cases: Annotated[int, typer.Option(min=2, max=200, help="Validation cases, at most.")] = 40,
) -> None:
    """Tell wrong slices from sound ones by all that the model knows."""
    with exit_status():
        opened = open_bundle(find_bundle(model, [shipped_bundles()]))
        chosen = load_cohort(cohort, data_folder(data), CohortOptions(skip_refused=True)).validation[:cases]
    sound = np.array([surprise(opened, parallel(case.mask, case.grid)) for case in chosen])
    limit = float(np.quantile(sound, 1.0 - FALSE_ALARMS))
    typer.echo(
        f"{len(chosen)} cases\n{'one of five wrong':20}{'ROC area':>10}{f'beyond {1 - FALSE_ALARMS:.0%} of sound':>24}"
    )
    for kind in WRONG_KINDS:
        wrong = np.array([surprise(opened, drawing) for drawing in _wrong_drawings(chosen, kind)])
        area = float(np.mean(wrong[:, None] > sound))
        typer.echo(f"{kind:20}{area:10.2f}{np.mean(wrong > limit):24.0%}")


def _wrong_drawings(cases: tuple[Case, ...], kind: WrongKind) -> Iterator[Sections]:
    for number, case in enumerate(cases):
        rng, other = np.random.default_rng(number), cases[(number + 1) % len(cases)]
        clean = parallel(case.mask, case.grid)
        yield with_wrong(clean, int(rng.integers(len(clean.stacks))), kind, rng, parallel(other.mask, other.grid))


if __name__ == "__main__":
    typer.run(main)
