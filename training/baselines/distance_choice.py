"""Choosing the settings of the distance modes on validation shapes, one after the other, and keeping the result.

The score is the mean over drawings of the mean average surface distance. Training and test shapes take no part.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from training.baselines.distance_fit import FitSettings, filled, fit_modes
from training.baselines.distance_learning import learn_modes
from training.baselines.distance_modes import DistanceModes
from training.baselines.kept_modes import ChosenModes, is_kept, write_chosen
from training.cohorts.cohort import Case, Cohort
from training.metrics_masks import agreement
from training.oblique import SliceStacks, in_one_stack, random_planes
from training.sparsify import for_evaluation

T = TypeVar("T")

#: Candidates, tried in this order, the other settings at their defaults or at what was chosen before.
WIDTHS_MM = (0.25, 0.5, 1.0)
PRECISIONS = (0.05, 0.2, 0.5)
SHARES = (0.95, 0.98, 0.99)
CLIPS_MM = (10.0, 5.0, 20.0)
#: Validation cases that are scored, evenly spaced.
SCORED_CASES = 3
#: Raised when the way of learning or choosing changes, so that kept results are made anew.
VERSION = 2


def choose(cohort: Cohort) -> ChosenModes:
    """Learn on the training cases and choose on the validation cases."""
    drawn = [(case, drawing) for case in spread(cohort.validation, SCORED_CASES) for drawing in drawings_of(case)]
    modes = {CLIPS_MM[0]: learn_modes(cohort.train, CLIPS_MM[0])}

    @cache
    def scored(clip: float, settings: FitSettings) -> float:
        return score(modes[clip], settings, drawn)

    settings = FitSettings()
    for name, candidates in (("width_mm", WIDTHS_MM), ("precision", PRECISIONS), ("share", SHARES)):
        trials = [replace(settings, **{name: value}) for value in candidates]
        settings = min(trials, key=partial(scored, CLIPS_MM[0]))
    modes |= {clip: learn_modes(cohort.train, clip) for clip in CLIPS_MM[1:]}
    clip = min(CLIPS_MM, key=lambda one: scored(one, settings))
    return ChosenModes(modes[clip].reduced(settings.share), settings)


def score(modes: DistanceModes, settings: FitSettings, drawn: Sequence[tuple[Case, SliceStacks]]) -> float:
    """Mean average surface distance (mm) over drawings."""
    reduced = modes.reduced(settings.share)
    found = []
    for case, drawing in drawn:
        fit = fit_modes(reduced, drawing.stacks, drawing.planes, settings)
        found.append(agreement(case.mask, filled(reduced, fit, case.grid), case.grid.spacing).asd_mm)
    return float(np.mean(found))


def drawings_of(case: Case) -> list[SliceStacks]:
    """Thin and orthogonal slices, and five random planes."""
    parallel, crossed = (for_evaluation(case.mask, case.grid, regime) for regime in ("thin", "orthogonal"))
    return [in_one_stack(parallel), in_one_stack(crossed), random_planes(case, 5)]


def kept(cohort: Cohort, folder: Path) -> Path:
    """Where the result of `choose` lies in a folder; made when it is not there yet for these masks."""
    path = folder / f"{cohort.name}-{cohort_digest(cohort)[:16]}.npz"
    if not is_kept(path):
        write_chosen(choose(cohort), path)
    return path


def cohort_digest(cohort: Cohort) -> str:
    """SHA-256 over what `choose` depends on."""
    found = hashlib.sha256(repr((VERSION, CLIPS_MM, SHARES, PRECISIONS, WIDTHS_MM, SCORED_CASES)).encode())
    for case in (*cohort.train, *cohort.validation):
        found.update(repr((case.name, case.split, case.mask.shape, case.grid.affine.tolist())).encode())
        found.update(np.packbits(case.mask).tobytes())
    return found.hexdigest()


def spread(values: Sequence[T], count: int) -> list[T]:
    """So many of the values, evenly spaced, the first and the last among them."""
    if count >= len(values):
        return list(values)
    return [values[int(place)] for place in np.linspace(0, len(values) - 1, count).round()]
