"""How much of the prior that codes were trained under stays: chosen by reconstructing held-out shapes from few slices.

By their density alone, codes of held-out shapes would often have less of it stay than is good for reconstruction: what
a sparse drawing asks of a code, and what the decoder cannot do, is not seen in codes of dense masks. So the prior that
is most fitted to the codes is taken of those with which validation shapes are reconstructed no worse than with the
model as it was trained.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from model.errors import InvalidParameter
from training.calibration import wrong_share
from training.cohorts.cohort import Case
from training.config import Regime
from training.pruning import PriorParts
from training.release import trial_model
from training.runs import mask_digest, read_record

#: Drawings of validation shapes that are reconstructed.
REGIMES: tuple[Regime, ...] = ("thin", "orthogonal")
#: Evenly spaced validation cases that are used at most.
CASES = 24
#: Models that are measured at most.
MODELS = 3

Watch = Callable[[], None]


@dataclass(frozen=True)
class Choice:
    """What was chosen, and by what.

    Attributes:
        parts: of the prior.
        error: share of voxels near the true surfaces on the wrong side.
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
    watch: Watch = lambda: None,
) -> Choice:
    """The most fitted prior with which shapes that were not trained on are reconstructed no worse than as trained.

    Args:
        run: a finished run with Gaussian codes.
        parts: what is fitted, with the least share of the training's prior; with all of it, and then with all
            dimensions, where that is not good enough.
        cases: at least one.
        regimes: of their drawings.
        watch: called after each model that was measured.

    Raises:
        InvalidParameter: the run is not finished, or was trained on one of the cases.
    """
    _check_unseen(run, cases)
    used = cases[:: -(-len(cases) // CASES)]

    def error(candidate: PriorParts | None) -> float:
        found = _error(run, candidate, used, regimes)
        watch()
        return found

    return choice_by(error, parts)


def _check_unseen(run: Path, cases: Sequence[Case]) -> None:
    seen = set(read_record(run)[1]["train"].values())
    names = [case.name for case in cases if mask_digest(case) in seen]
    if names:
        raise InvalidParameter(
            f"The run was trained on {names[0]}, which is to be a validation case; the cohort, and the seed, of the "
            "training are accepted.",
            part="cohort",
        )


def choice_by(error: Callable[[PriorParts | None], float], parts: PriorParts) -> Choice:
    """The choice given the error with some parts, and with None that of the model as it was trained."""
    trained = error(None)
    *fitted, as_trained = _by_fitness(parts)
    for candidate in fitted:
        found = error(candidate)
        if found <= trained:
            return Choice(candidate, found, trained)
    return Choice(as_trained, trained, trained)


def _by_fitness(parts: PriorParts) -> Iterator[PriorParts]:
    """The last one is the model as it was trained, in principal coordinates."""
    yield parts
    yield replace(parts, least_of_training=1.0)
    yield replace(parts, least_of_training=1.0, least_movement=0.0)


def _error(run: Path, parts: PriorParts | None, cases: Sequence[Case], regimes: Sequence[Regime]) -> float:
    model = trial_model(run, parts)
    return float(np.mean([wrong_share(model, case, regime) for case in cases for regime in regimes]))
