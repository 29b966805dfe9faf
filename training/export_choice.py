"""What a caller of an export chooses of its prior, and what is fitted to the codes of a run then."""

from dataclasses import dataclass

from model.errors import InvalidParameter
from training.choices import LEAST_MOVEMENT, LEAST_OF_TRAINING
from training.pruning import PriorParts


@dataclass(frozen=True)
class ExportChoice:
    """What a caller chooses of an export's prior; what is None follows from the run.

    Attributes:
        prune: whether flow and relevance are fitted to the codes; where the prior stood still in training when None.
        least_movement, least_of_training: see `PriorParts`.
        by_cohort: whether shapes of a cohort choose how much of the training's prior stays.
    """

    prune: bool | None = None
    least_movement: float | None = None
    least_of_training: float | None = None
    by_cohort: bool = False

    def parts(self, *, stood_still: bool) -> PriorParts | None:
        """What is fitted to the codes of a run; nothing when None.

        Args:
            stood_still: whether neither flow nor ARD was trained along (`training.release.wants_prior`).

        Raises:
            InvalidParameter: something was chosen that would do nothing for this run.
        """
        fitted = stood_still if self.prune is None else self.prune
        if not fitted and (self.least_movement is not None or self.least_of_training is not None):
            raise InvalidParameter(
                "Nothing is pruned, so that --least-movement and --training-share would do nothing; they are accepted "
                "with --prune.",
                part="prune",
            )
        if self.by_cohort and not (fitted and stood_still):
            raise InvalidParameter(
                "A cohort chooses how much of the training's prior stays; it is accepted where a prior is fitted to "
                "the codes of a run without a flow or ARD of its own.",
                part="cohort",
            )
        return self._parts() if fitted else None

    def _parts(self) -> PriorParts:
        return PriorParts(
            least_movement=LEAST_MOVEMENT if self.least_movement is None else self.least_movement,
            least_of_training=LEAST_OF_TRAINING if self.least_of_training is None else self.least_of_training,
        )
