"""From two planes on: the plane that is advised each time, beside random ones."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.uncertainty.cells import Payload
from model.bundle import ShapeModel
from model.errors import InputError
from model.inference.mask_stack import MaskStack, Plane
from model.inference.next_plane import next_plane
from model.inference.one_body import body_mask
from model.inference.reconstruction import Options, Reconstruction, reconstruct
from training.cohorts.cohort import Case
from training.metrics_masks import agreement

#: Numbers of planes, from the first on.
FIRST, LAST = 2, 6
#: Random planes show a section of at least this share of the largest one along their axis, as a person's would.
SHOWN = 0.25
#: Runs with random planes; those of a strategy that is advised differ in the two planes that they start from.
RUNS = 3


def measure_next_planes(model: ShapeModel, case: Case, advised: bool, run: int) -> Payload:
    """ASD (mm) after each number of planes; the two to begin with are the same for both strategies."""
    random = np.random.default_rng(int(hashlib.sha256(f"{case.name} {run}".encode()).hexdigest()[:12], 16))
    order = _random_order(case, random)
    planes, distances = order[:FIRST], []
    for count in range(FIRST, LAST + 1):
        stack = MaskStack("mask[0]", case.grid, case.mask, np.zeros(case.mask.shape, bool))
        answer = reconstruct(model, [stack], Options(annotated=tuple(planes)))
        found = body_mask(model, replace(answer.state, covariance=None), answer.mesh, case.grid)
        distances.append(agreement(case.mask, found, case.grid.spacing).asd_mm)
        if count < LAST:
            chosen = _advised(model, case, answer, planes) if advised else None
            planes = [*planes, chosen or next(plane for plane in order if plane not in planes)]
    return {"asd_mm": distances}


def _advised(model: ShapeModel, case: Case, answer: Reconstruction, planes: Sequence[Plane]) -> Plane | None:
    try:
        return next_plane(model, answer.state.fits[0], answer.mesh, case.grid, planes).cut.plane
    except InputError:
        return None


def _random_order(case: Case, random: np.random.Generator) -> list[Plane]:
    """Planes of voxels that show the object, of a random axis and place each."""
    areas = [case.mask.sum(axis=tuple(a for a in range(3) if a != axis)) for axis in range(3)]
    held = [np.flatnonzero(area >= SHOWN * area.max()) for area in areas]
    order: list[Plane] = []
    while len(order) < LAST * 3:
        axis = int(random.integers(3))
        plane = Plane(0, axis, int(random.choice(held[axis])))
        if plane not in order:
            order.append(plane)
    return order
