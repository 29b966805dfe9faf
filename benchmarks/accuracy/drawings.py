"""The drawings that are measured: thin, thick and orthogonal slices, and random planes."""

from enum import StrEnum

from training.cohorts.cohort import Case
from training.oblique import SliceStacks, in_one_stack, random_planes
from training.sparsify import REGIMES, for_evaluation


class DrawingName(StrEnum):
    """How a case is drawn; ``planes-n`` are n random planes of any orientation."""

    THIN = "thin"
    THICK = "thick"
    ORTHOGONAL = "orthogonal"
    PLANES_2 = "planes-2"
    PLANES_3 = "planes-3"
    PLANES_5 = "planes-5"
    PLANES_8 = "planes-8"
    PLANES_16 = "planes-16"

    @property
    def parallel(self) -> bool:
        """Whether all slices lie along one axis."""
        return self in (DrawingName.THIN, DrawingName.THICK)

    @property
    def random(self) -> bool:
        """Whether planes have any orientation."""
        return self.value.startswith("planes-")


def draw(case: Case, name: DrawingName) -> SliceStacks:
    """The drawing of a case: a pure function of its mask, its name and the drawing's."""
    if name.random:
        return random_planes(case, int(name.value.removeprefix("planes-")))
    (regime,) = [regime for regime in REGIMES if regime == name.value]
    return in_one_stack(for_evaluation(case.mask, case.grid, regime))
