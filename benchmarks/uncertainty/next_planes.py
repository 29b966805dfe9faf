"""From two planes on: the plane that is advised each time, beside random ones."""

import hashlib
from dataclasses import replace

import numpy as np

from benchmarks.uncertainty.cells import Payload
from model.bundle import ShapeModel
from model.errors import InputError
from model.inference.mask_stack import MaskStack, Plane
from model.inference.next_plane import next_plane
from model.inference.reconstruction import Options, reconstruct
from model.inference.uncertainty import occupancy
from training.cohorts.cohort import Case
from training.metrics_masks import agreement

#: Numbers of planes, from the first on.
FIRST, LAST = 2, 6
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
        found = occupancy(model, replace(answer.state, covariance=None), case.grid) >= 0.5
        distances.append(agreement(case.mask, found, case.grid.spacing).asd_mm)
        if count < LAST:
            planes = [*planes, _following(model, case, answer.state.fits[0], answer.mesh, planes, order, advised)]
    return {"asd_mm": distances}


def _following(model, case, fit, mesh, planes, order, advised):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    if advised:
        try:
            chosen = next_plane(model, fit, mesh, case.grid, planes).cut.plane
        except InputError:
            chosen = None
        if chosen is not None:
            return chosen
    return next(plane for plane in order if plane not in planes)


def _random_order(case: Case, random: np.random.Generator) -> list[Plane]:
    """Planes of voxels that hold foreground, of a random axis and place each."""
    held = [np.flatnonzero(case.mask.any(axis=tuple(a for a in range(3) if a != axis))) for axis in range(3)]
    order: list[Plane] = []
    while len(order) < LAST * 3:
        axis = int(random.integers(3))
        plane = Plane(0, axis, int(random.choice(held[axis])))
        if plane not in order:
            order.append(plane)
    return order
