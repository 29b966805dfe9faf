"""From a sweep's folder to a chapter of the page: its table, and the panels that its licence and its files allow."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

from model.bundle import ShapeModel, open_bundle
from model.errors import MorphoFlowError
from training.cohorts.cohort import Case, Cohort
from training.config import Regime
from training.reporting import panels
from training.reporting.page import Chapter, Panel
from training.reporting.paper import bone_of
from training.reporting.tables import SIDES, lines_of, paired_difference
from training.sweep.cell import CELLS
from training.sweep.priors import PriorName
from training.sweep.summary import correlation
from training.sweep.table import Result

#: The latent size of the paper's pictures.
PICTURED = 64
WITHHELD = "Left out: pictures of these shapes are not to be passed on."


def chapter_of(
    folder: Path, results: Sequence[Result], cohort: Cohort | None, *, pictures: bool, watch: Callable[[str], None]
) -> Chapter:
    """The chapter of one cohort.

    Args:
        folder: of the sweep, where the bundles of the cells lie.
        cohort: its shapes by `pictured_seed`, for the panels that show them; None where they cannot be read any more.
        pictures: whether panels may show shapes (A, D and E).
        watch: told which panel is drawn.
    """
    made: list[Panel] = []
    for draw in (_panel_a, _panel_b, _panel_c, _panel_d, _panel_e):
        watch(draw.__name__[-1].upper())
        made += draw(folder, results, cohort if pictures else None, pictures)
    first = results[0]
    return Chapter(first.cohort, _facts(results), lines_of(results), _paired(results), made)


def _facts(results: Sequence[Result]) -> list[str]:
    first = results[0]
    shapes, steps = (
        ", ".join(map(str, sorted({getattr(one, name) for one in results}))) for name in ("shapes", "steps")
    )
    objectives = ", ".join(sorted({one.objective for one in results}))
    words = [
        f"{first.source}; licence: {first.licence}. {shapes} training shapes.",
        f"Optimiser steps of a cell: {steps}; objective: {objectives}.",
    ]
    bone = bone_of(first.cohort)
    if bone is not None:
        words.append(
            f"The paper's columns are its {bone} table, measured on {'VerSe' if bone == 'vertebra' else 'OAI-ZIB'}."
        )
    return words


def _paired(results: Sequence[Result]) -> list[str]:
    found = []
    for line in lines_of(results):
        wanted = (line.trained, line.latent_size, line.objective)
        mine = [one for one in results if (one.regime, one.latent_size, one.objective) == wanted]
        asd = paired_difference(mine, "asd_mm", line.measured)
        if asd is not None:
            found.append(
                f"D = {line.latent_size}, trained on {line.trained}, measured in {line.measured}: flow and ARD change "
                f"ASD by {asd[0]:+.3f} ± {asd[1]:.3f} mm (mean and standard error of the paired difference, "
                f"{asd[2]} shapes)."
            )
    return found


def _pictured(results: Sequence[Result]) -> list[Result]:
    """Results of the paper's latent size, or of the largest one there is."""
    sizes = {one.latent_size for one in results}
    size = PICTURED if PICTURED in sizes else max(sizes)
    return [one for one in results if one.latent_size == size]


def pictured_seed(results: Sequence[Result]) -> int:
    """The seed of the cells whose reconstructions are pictured, which says what their test shapes are.

    The least one, of cells with flow and ARD where there are any.
    """
    shown = _pictured(results)
    full = [one for one in shown if one.prior == PriorName.FLOW_ARD.value]
    return min(one.seed for one in full or shown)


def _reconstructed(results: Sequence[Result]) -> list[Result]:
    """Those of the pictured results that know the cohort's test shapes."""
    seed = pictured_seed(results)
    return [one for one in _pictured(results) if one.seed == seed]


def _opened(folder: Path, result: Result) -> ShapeModel | None:
    try:
        return open_bundle(folder / CELLS / result.key / "bundle", threads=1)
    except (MorphoFlowError, OSError):
        return None


def _panel_a(folder: Path, results: Sequence[Result], cohort: Cohort | None, pictures: bool) -> list[Panel]:
    title = "A. Best, median and worst reconstructions"
    if cohort is None:
        return [Panel(title, WITHHELD if not pictures else "Left out: the cohort could not be read.")]
    cases: dict[str, Case] = {case.name: case for case in cohort.test}
    found = []
    shown = _reconstructed(results)
    for trained, measured in dict.fromkeys((one.regime, name) for one in shown for name in one.measured):
        mine = {one.prior: one for one in shown if one.regime == trained}
        leading = mine.get(PriorName.FLOW_ARD.value) or next(iter(mine.values()))
        choices = panels.best_median_worst(leading, measured)
        choices = {word: name for word, name in choices.items() if name in cases}
        models = {words: _opened(folder, mine[prior.value]) for prior, words in SIDES if prior.value in mine}
        there = {words: model for words, model in models.items() if model is not None}
        if choices and there:
            png = panels.reconstructions(there, cases, choices, cast(Regime, measured))
            words = f"Trained on {trained}, measured in {measured}, D = {leading.latent_size}; chosen by ASD."
            found.append(Panel(f"{title}: {measured}", words, png))
    return found or [Panel(title, "Left out: no model or no case is there any more.")]


def _panel_b(folder: Path, results: Sequence[Result], cohort: Cohort | None, pictures: bool) -> list[Panel]:
    del folder, cohort, pictures
    mine = [one for one in results if one.prior == PriorName.FLOW_ARD.value]
    title = "B. Sorted sigmas of the base"
    if not mine:
        return [Panel(title, "Left out: no cell has flow and ARD.")]
    return [
        Panel(
            title,
            "With flow and ARD; a curve that falls early says that few dimensions are in use.",
            panels.sorted_sigmas(mine),
        )
    ]


def _panel_c(folder: Path, results: Sequence[Result], cohort: Cohort | None, pictures: bool) -> list[Panel]:
    del folder, cohort, pictures
    title = "C. Generated shapes: latent and surface distance"
    mine = [one for one in _pictured(results) if one.prior == PriorName.FLOW_ARD.value and len(one.latent) > 2]
    if not mine:
        return [Panel(title, "Left out: no cell with flow and ARD has generated shapes.")]
    return [
        Panel(
            f"{title}, trained on {one.regime}",
            f"{len(one.latent)} shapes drawn from the base, each beside the nearest training shape.",
            panels.correlation_plot(one, correlation(one) ** 2, correlation(one)),
        )
        for one in mine
    ]


def _panel_d(folder: Path, results: Sequence[Result], cohort: Cohort | None, pictures: bool) -> list[Panel]:
    title = "D. Uncertainty"
    if cohort is None:
        return [Panel(title, WITHHELD if not pictures else "Left out: the cohort could not be read.")]
    result = next((one for one in _reconstructed(results) if one.prior == PriorName.FLOW_ARD.value), None)
    model = None if result is None else _opened(folder, result)
    cases = {case.name: case for case in cohort.test}
    if result is None or model is None:
        return [Panel(title, "Left out: no cell with flow and ARD is there.")]
    regime = next(iter(result.measured))
    name = panels.best_median_worst(result, regime).get("median", "")
    if name not in cases:
        return [Panel(title, "Left out: the case is not there any more.")]
    png = panels.uncertainty(model, cases[name], cast(Regime, regime))
    words = f"The median case of {regime}: posterior of one fit; the line is the true outline."
    return [Panel(title, words, png)]


def _panel_e(folder: Path, results: Sequence[Result], cohort: Cohort | None, pictures: bool) -> list[Panel]:
    del cohort
    title = "E. Generated shapes"
    if not pictures:
        return [Panel(title, WITHHELD)]
    result = next((one for one in _pictured(results) if one.prior == PriorName.FLOW_ARD.value), None)
    model = None if result is None else _opened(folder, result)
    if model is None:
        return [Panel(title, "Left out: no cell with flow and ARD is there.")]
    return [Panel(title, "The first draws of the prior (seeds 0 to 5).", panels.generated_shapes(model))]
