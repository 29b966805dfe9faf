"""Mirror images join where the cohort says that the structure has no side."""

import pytest

from tests.ellipsoid_cohort import GRID, ellipsoids
from training.choices import DeviceName, ObjectiveName, RegimeName, TrainingChoice
from training.cohorts import Case, Cohort, Provenance
from training.cohorts.cohort import NOT_STATED, SideName
from training.configuring import configured_for


def reflected(side, **more):
    cases = tuple(Case(f"e{n}", f"e{n}", "train", shape.mask(GRID), GRID) for n, shape in enumerate(ellipsoids(4)))
    made = Provenance("made here", "CC0-1.0", "nobody", shippable=True)
    cohort = Cohort("ellipsoids", cases, (), (), (), made, NOT_STATED if side is None else side.value)
    choices = {"objective": ObjectiveName.VARIATIONAL, **more}
    choice = TrainingChoice(regime=RegimeName.DENSE, latent_size=4, steps=8, device=DeviceName.CPU, **choices)
    return configured_for(cohort, choice).reflected


@pytest.mark.parametrize("side", [None, *SideName])
def test_only_a_structure_without_sides_is_mirrored_unless_it_is_asked_for(side):
    assert reflected(side) is (side is SideName.UNPAIRED)
    assert reflected(side, reflect=True)
    assert not reflected(side, reflect=False)


def test_the_papers_objective_has_no_mirror_images():
    assert not reflected(SideName.UNPAIRED, objective=ObjectiveName.PAPER)
