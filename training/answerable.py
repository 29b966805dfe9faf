"""Drawings of validation shapes that a model can answer, and errors that say of which shape and drawing they are.

A drawing of a short object may show it on one plane only. That tells nothing of its shape along the other axis, and no
reconstruction takes it; a person would draw more. Such drawings are left out of what is chosen on validation shapes.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Protocol, TypeVar

from model.errors import CohortError, InputError
from model.inference.mask_stack import MaskStack, Plane, section_of
from training.cohorts.cohort import Case
from training.oblique import SliceStacks, in_one_stack
from training.sparsify import Regime, for_evaluation

#: Planes on which a drawing has to show the object.
LEAST_PLANES = 2


class Drawn(Protocol):
    """Planes in stacks."""

    @property
    def stacks(self) -> tuple[MaskStack, ...]:
        """What was drawn."""

    @property
    def planes(self) -> tuple[Plane, ...]:
        """Where."""


Name = TypeVar("Name", bound=str)
AnyDrawn = TypeVar("AnyDrawn", bound=Drawn)


def answerable(drawings: Mapping[Name, AnyDrawn]) -> dict[Name, AnyDrawn]:
    """Those of a case's drawings that show the object on `LEAST_PLANES` planes, by their names."""
    return {name: drawing for name, drawing in drawings.items() if _shown(drawing) >= LEAST_PLANES}


def answerable_drawings(case: Case, regimes: Sequence[Regime]) -> dict[Regime, SliceStacks]:
    """The drawings of a case for evaluation that are `answerable`, by regime."""
    return answerable({regime: in_one_stack(for_evaluation(case.mask, case.grid, regime)) for regime in regimes})


def answerable_cases(cases: Sequence[Case], regimes: Sequence[Regime]) -> list[Case]:
    """Those of validation cases that have an answerable drawing.

    Raises:
        CohortError: none has.
    """
    found = [case for case in cases if answerable_drawings(case, regimes)]
    if not found:
        raise CohortError(
            f"No drawing ({', '.join(regimes)}) of the validation shapes shows its shape on {LEAST_PLANES} planes; "
            "shapes of more slices, or on finer voxels, are accepted."
        )
    return found


@contextmanager
def naming(case: Case, drawing: str) -> Iterator[None]:
    """Let an error about a drawing say of which case it is.

    Raises:
        CohortError: in place of an `InputError`.
    """
    try:
        yield
    except InputError as error:
        why = str(error).rstrip(".")
        raise CohortError(
            f"{case.name}: its drawing ({drawing}) cannot be reconstructed ({why}); a cohort without it is accepted."
        ) from error


def _shown(drawing: Drawn) -> int:
    return sum(bool(section_of(drawing.stacks[plane.stack].foreground, plane).any()) for plane in drawing.planes)
