"""Choosing the settings of the distance modes on validation shapes, one after the other, and keeping the result.

The score is the mean over drawings of the mean average surface distance. Training and test shapes take no part.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from training.baselines.distance_fit import FitSettings, filled, fit_modes
from training.baselines.distance_learning import learn_modes
from training.baselines.distance_modes import DistanceModes
from training.cohorts.cohort import Case, Cohort
from training.metrics_masks import agreement
from training.oblique import SliceStacks, random_planes
from training.sparsify import for_evaluation

T = TypeVar("T")

#: Candidates, tried in this order, the other settings at their defaults or at what was chosen before.
CLIPS_MM = (5.0, 10.0, 20.0)
SHARES = (0.9, 0.95, 0.98, 0.99)
PRECISIONS = (0.02, 0.05, 0.2, 0.5)
WIDTHS_MM = (0.5, 1.0, 2.0)
#: Validation cases that are scored, evenly spaced.
SCORED_CASES = 6
#: Raised when the way of learning or choosing changes, so that kept results are made anew.
VERSION = 1


@dataclass(frozen=True)
class ChosenModes:
    """Modes, reduced to those in use, and the settings of their fit."""

    modes: DistanceModes
    settings: FitSettings


def choose(cohort: Cohort) -> ChosenModes:
    """Learn on the training cases and choose on the validation cases."""
    drawn = [(case, drawing) for case in spread(cohort.validation, SCORED_CASES) for drawing in drawings_of(case)]
    settings = FitSettings()
    modes = _best([learn_modes(cohort.train, clip) for clip in CLIPS_MM], lambda one: score(one, settings, drawn))
    for name, candidates in (("share", SHARES), ("precision", PRECISIONS), ("width_mm", WIDTHS_MM)):
        trials = [replace(settings, **{name: value}) for value in candidates]
        settings = _best(trials, lambda one: score(modes, one, drawn))
    return ChosenModes(modes.reduced(settings.share), settings)


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
    singles = [SliceStacks((drawing.stack,), drawing.planes) for drawing in (parallel, crossed)]
    return [*singles, random_planes(case, 5)]


def kept(cohort: Cohort, folder: Path) -> ChosenModes:
    """`choose`, or what it found before in this folder on the same masks."""
    path = folder / f"{cohort.name}-{digest_of(cohort)[:16]}.npz"
    record = path.with_suffix(".json")
    if path.is_file() and record.is_file():
        return ChosenModes(DistanceModes.load(path), FitSettings(**json.loads(record.read_text(encoding="utf-8"))))
    found = choose(cohort)
    found.modes.save(path)
    record.write_text(json.dumps(asdict(found.settings)) + "\n", encoding="utf-8")
    return found


def digest_of(cohort: Cohort) -> str:
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


def _best(candidates: Sequence[T], score_of: Callable[[T], float]) -> T:
    return min(candidates, key=score_of)
