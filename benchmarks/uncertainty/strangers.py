"""Shapes that are no hippocampi sent to the hippocampus model, and hippocampi."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from benchmarks.uncertainty.cells import Payload
from model.bundle import ShapeModel
from model.errors import InputError
from model.geometry import Grid
from model.inference.reconstruction import Options, reconstruct
from training.cohorts.cohort import Case
from training.sparsify import Regime, for_evaluation

#: Radii of the balls (mm).
RADII_MM = (6.0, 8.0, 10.0, 12.0, 15.0, 20.0)
#: What the service says of a shape that it does not know.
UNLIKE = "unlike the population"


@dataclass(frozen=True)
class Trial:
    """A shape, and what it is."""

    kind: str
    name: str
    mask: Bool[np.ndarray, "i j k"]
    grid: Grid


def trials(own: Sequence[Case], others: Mapping[str, Sequence[Case]]) -> Iterator[Trial]:
    """Own shapes, the same mirrored, balls, and shapes of other cohorts."""
    for case in own:
        yield Trial("own", case.name, case.mask, case.grid)
        yield Trial("mirrored", case.name, case.mask[::-1].copy(), case.grid)
    for radius in RADII_MM:
        half = int(radius) + 5
        index = np.indices((2 * half + 1,) * 3) - half
        grid = Grid((2 * half + 1,) * 3, np.eye(4))
        yield Trial("sphere", f"{radius:g} mm", np.asarray((index**2).sum(axis=0) < radius**2), grid)
    for kind, cases in others.items():
        for case in cases:
            yield Trial(kind, case.name, case.mask, case.grid)


def measure_trial(model: ShapeModel, trial: Trial, regime: Regime) -> Payload:
    """Whether the answer says that it does not know the shape; a refusal says so too."""
    try:
        drawing = for_evaluation(trial.mask, trial.grid, regime)
        answer = reconstruct(model, [drawing.stack], Options(annotated=drawing.planes))
    except InputError as error:
        return {"unlike": True, "warned": True, "percentile": None, "refusal": str(error)}
    return {
        "unlike": any(UNLIKE in sentence for sentence in answer.warnings),
        "warned": bool(answer.warnings),
        "percentile": answer.typicality_percentile,
        "refusal": "",
        "warnings": list(answer.warnings),
    }
