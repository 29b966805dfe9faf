"""How much of the prior that codes were trained under stays: chosen by reconstructing held-out shapes from few slices.

By their density alone, codes of held-out shapes would often have less of it stay than is good for reconstruction: what
a sparse drawing asks of a code, and what the decoder cannot do, is not seen in codes of dense masks. So the prior that
is most fitted to the codes is taken of those with which validation shapes surely come out as near to their masks as
with the model as it was trained, at the likelihood precision that is best for that one: a narrower prior makes up for
one that is too low, and calibration will find a better.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.errors import InvalidParameter
from training.answerable import answerable_cases, answerable_drawings
from training.calibration import PRECISIONS, Advance, with_precision
from training.cohorts.cohort import Case, evenly, listed
from training.config import Regime
from training.evaluate import reconstruction_error_mm
from training.pruning import PriorParts
from training.release import trial_model
from training.runs import mask_digest, read_record
from training.seen import is_among

#: Drawings of validation shapes that are reconstructed.
REGIMES: tuple[Regime, ...] = ("thin", "orthogonal")
#: Evenly spaced validation cases that are used at most.
CASES = 24
#: A prior is as good when its error, and twice the standard error of the difference more, is no more than this share
#: above that of the model as it was trained.
MARGIN = 0.002
#: Fitted priors that are measured at most; the trained model is with every precision.
FITTED = 2
MODELS = len(PRECISIONS) + FITTED


@dataclass(frozen=True)
class Choice:
    """What was chosen, and by what.

    Attributes:
        parts: of the prior.
        error: average surface distance of the reconstructions from the masks (mm), mean over cases and drawings.
        trained_error: the same of the model as it was trained.
    """

    parts: PriorParts
    error: float
    trained_error: float


def chosen_parts(
    run: Path,
    parts: PriorParts,
    cases: Sequence[Case],
    regimes: Sequence[Regime] = REGIMES,
    precisions: Sequence[float] = PRECISIONS,
    advance: Advance = lambda: None,
) -> Choice:
    """The most fitted prior with which shapes that were not trained on are reconstructed as well as with the trained.

    Args:
        run: a finished run with Gaussian codes.
        parts: what is fitted, with the least share of the training's prior; with all of it, and then with all
            dimensions and its own centre, where that is not good enough.
        cases: at least one.
        regimes: of their drawings.
        precisions: likelihood precisions (1/mm^2) that the model may come to be used at.
        advance: called after each model that was measured.

    Raises:
        InvalidParameter: the run is not finished, or was trained on one of the cases.
        CohortError: a drawing of a case cannot be reconstructed, or none shows enough.
    """
    _check_unseen(run, cases)
    used = answerable_cases(evenly(cases, CASES), regimes)

    def errors(model: ShapeModel, precision: float) -> Float[np.ndarray, "n"]:
        found = _errors(model, precision, used, regimes)
        advance()
        return found

    as_trained = trial_model(run, None)
    trained = {precision: errors(as_trained, precision) for precision in precisions}
    best = min(trained, key=lambda precision: float(trained[precision].mean()))
    return choice_by(trained[best], lambda candidate: errors(trial_model(run, candidate), best), parts)


def check_own(run: Path, cases: Sequence[Case]) -> None:
    """Refuse training shapes of another cohort than that of the run.

    Raises:
        InvalidParameter: the run was trained on none of the cases.
    """
    if cases and not _trained_on(run, cases):
        raise InvalidParameter(
            "The run was trained on other shapes than those of this cohort; the cohort, --seed and --test-fraction of "
            "the training are accepted.",
            part="cohort",
        )


def _trained_on(run: Path, cases: Sequence[Case]) -> list[str]:
    values = read_record(run)[1]
    seen = {*values["train"].values(), *values.get("voxel_digests", ())}
    return [case.name for case in cases if mask_digest(case) in seen or is_among(case, seen)]


def _check_unseen(run: Path, cases: Sequence[Case]) -> None:
    names = _trained_on(run, cases)
    if names:
        raise InvalidParameter(
            f"The run was trained on {listed(names)}, which is to be among the validation cases; the cohort, --seed "
            "and --test-fraction of the training are accepted.",
            part="cohort",
        )


def choice_by(
    trained: Float[np.ndarray, "n"], errors: Callable[[PriorParts], Float[np.ndarray, "n"]], parts: PriorParts
) -> Choice:
    """The choice given each case's error (mm) with the trained model and with some parts."""
    *fitted, as_trained = _by_fitness(parts)
    for candidate in fitted:
        found = errors(candidate)
        if _as_good(found, trained):
            return Choice(candidate, float(found.mean()), float(trained.mean()))
    return Choice(as_trained, float(trained.mean()), float(trained.mean()))


def _as_good(found: Float[np.ndarray, "n"], trained: Float[np.ndarray, "n"]) -> bool:
    """Never of a single case, which does not tell how much differs by chance."""
    if len(found) < 2:
        return False
    more = found - trained
    surely = more.mean() + 2.0 * more.std(ddof=1) / np.sqrt(len(more))
    return bool(surely <= MARGIN * trained.mean())


def _by_fitness(parts: PriorParts) -> Iterator[PriorParts]:
    """The last one is the model as it was trained, in principal coordinates."""
    yield parts
    yield replace(parts, least_of_training=1.0)
    yield replace(parts, least_of_training=1.0, least_movement=0.0, keep_centre=True)


def _errors(
    model: ShapeModel, precision: float, cases: Sequence[Case], regimes: Sequence[Regime]
) -> Float[np.ndarray, "n"]:
    """Average surface distance (mm) of each case at a likelihood precision (1/mm^2), mean over its drawings."""
    trial = with_precision(model, precision)
    drawn = [(case, answerable_drawings(case, regimes)) for case in cases]
    return np.array(
        [np.mean([reconstruction_error_mm(trial, case, regime) for regime in found]) for case, found in drawn]
    )
