"""Two ellipsoids as validation cases of a cohort."""

import numpy as np

from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import cube_around, rotation
from training.cohorts.cohort import Case

CENTRE = np.array([30.0, -20.0, 50.0])
GRID = cube_around(CENTRE, nodes=37)
CASES = [
    Case(name, name, "validation", Ellipsoid(axes, CENTRE, rotation(10.0)).mask(GRID), GRID)
    for name, axes in (("long", (14.5, 8.5, 7.5)), ("short", (11.5, 9.5, 7.0)))
]
