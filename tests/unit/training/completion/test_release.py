"""What a completion network is trained with on a cohort."""

import numpy as np
import pytest

from model.geometry import Grid
from model.networks.completion import MULTIPLE
from tests.analytic_shapes import Ellipsoid
from training.cohorts.cohort import Case, Cohort, Provenance
from training.completion.release import LEAST_STEP_MM, MOST_VOXELS, completion_config
from training.completion.samples import windows_of

GRID = Grid((30, 30, 30), np.diag([1.0, 1.0, 1.0, 1.0]))
CASE = Case("e", "e", "train", Ellipsoid((7.0, 8.0, 9.0), np.full(3, 14.5)).mask(GRID), GRID)
WINDOWS = windows_of([CASE])


def cohort(side):
    return Cohort("e", (CASE,), (), (), (), Provenance("made here", "CC0", "nobody", shippable=True), side)


@pytest.mark.parametrize(
    ("side", "reflected"), [("mixed", True), ("unpaired", True), ("left", False), ("not stated", False)]
)
def test_mirror_images_are_learnt_from_where_both_sides_come(side, reflected):
    config = completion_config(cohort(side), WINDOWS, reflect=None, steps=None, seed=3)
    assert config.reflected is reflected
    assert config.seed == 3


@pytest.mark.parametrize("side", ["mixed", "left"])
@pytest.mark.parametrize("reflect", [True, False])
def test_a_caller_may_say_otherwise(side, reflect):
    assert completion_config(cohort(side), WINDOWS, reflect=reflect, steps=7, seed=0).reflected is reflect


def test_the_lattice_holds_the_shape_within_the_limits():
    config = completion_config(cohort("left"), WINDOWS, reflect=None, steps=None, seed=0)
    assert np.prod(config.voxels) <= MOST_VOXELS
    assert config.step_mm == LEAST_STEP_MM
    assert all(count % MULTIPLE == 0 for count in config.voxels)
    assert (np.array(config.voxels) * config.step_mm >= 2.0 * np.array([7.0, 8.0, 9.0])).all()
