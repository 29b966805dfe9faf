"""An ellipsoid drawn on three planes that leave room, and its fit with a discrepancy."""

from dataclasses import replace

import numpy as np

from model.inference.discrepancy.conditioning import DiscrepancyPrior, with_discrepancy
from model.inference.fitting import Fit, FitOptions, fit
from model.inference.mask_stack import Plane
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import cube_around, drawn, observed

CENTRE = np.array([30.0, -20.0, 50.0])
GRID = cube_around(CENTRE)
MODEL = replace(ellipsoid_model(), manifest=replace(ellipsoid_model().manifest, likelihood_precision=0.1))
MIDDLE = round(float(GRID.to_index(CENTRE[None])[0, 0]))
PLANES = (Plane(0, 2, MIDDLE - 3), Plane(0, 2, MIDDLE + 3), Plane(0, 0, MIDDLE))
STACK = drawn(Ellipsoid((13.0, 9.0, 6.5), CENTRE), GRID, PLANES)
OBSERVATIONS = observed(STACK, PLANES)


def fitted(fidelity: float, spread_mm: float = 0.6) -> Fit:
    """The fit with what its contours show, followed as far as `fidelity` says."""
    found = fit(MODEL, OBSERVATIONS, FitOptions(robust=False))
    return with_discrepancy(MODEL, found, [STACK], OBSERVATIONS, DiscrepancyPrior(spread_mm, fidelity))
