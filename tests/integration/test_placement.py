"""Real hippocampi drawn elsewhere, turned and mirrored come back as good as before."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.placement import Placement, measure, placements
from model.bundle import open_bundle
from training.cohorts import CohortName, CohortOptions, load_cohort

CASES = 3


@pytest.fixture(scope="module")
def mean_asd(shipped_bundles: tuple[Path, ...], shared_data: Path):
    (folder,) = [path for path in shipped_bundles if path.name == "hippocampus"]
    model = open_bundle(folder, threads=1)
    cases = load_cohort(CohortName.HIPPOCAMPUS, shared_data, CohortOptions()).test[:CASES]

    def over_cases(placement: Placement) -> float:
        return float(np.mean([measure(model, case, "orthogonal", placement).asd_mm for case in cases]))

    return over_cases


@pytest.fixture(scope="module")
def asd_as_drawn(mean_asd):
    return mean_asd(Placement("as drawn", np.eye(4)))


ELSEWHERE = [placement for placement in placements() if not placement.name.startswith(("as drawn", "10 "))]


@pytest.mark.parametrize("placement", ELSEWHERE, ids=lambda placement: placement.name)
def test_accuracy_does_not_depend_on_the_place(mean_asd, asd_as_drawn, placement):
    assert mean_asd(placement) <= 1.1 * asd_as_drawn
