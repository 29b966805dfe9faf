"""What the shipped hippocampus model says of shapes that are no hippocampi."""

from pathlib import Path

import numpy as np
import pytest

from model.bundle import ShapeModel, open_bundle
from model.geometry import Grid
from model.inference.reconstruction import Options, Reconstruction, reconstruct
from training.cohorts import Case, CohortName, CohortOptions, load_cohort
from training.sparsify import for_evaluation

UNLIKE = "unlike the population"


@pytest.fixture(scope="module")
def hippocampus(shipped_bundles: tuple[Path, ...]) -> ShapeModel:
    (folder,) = [path for path in shipped_bundles if path.name == "hippocampus"]
    return open_bundle(folder, threads=1)


def answer(model: ShapeModel, mask: np.ndarray, grid: Grid, regime: str) -> Reconstruction:
    drawing = for_evaluation(mask, grid, regime)
    return reconstruct(model, [drawing.stack], Options(uncertainty="none"))


def first_test_case(name: CohortName, folder: Path) -> Case:
    return load_cohort(name, folder, CohortOptions()).test[0]


@pytest.mark.parametrize("regime", ["orthogonal", "thin"])
@pytest.mark.parametrize("name", [CohortName.FEMUR, CohortName.TALUS, CohortName.VERTEBRA])
def test_other_bones_are_answered_and_flagged(hippocampus, shared_data, name, regime):
    case = first_test_case(name, shared_data)
    found = answer(hippocampus, case.mask, case.grid, regime)
    assert not found.mesh.is_empty
    assert any(UNLIKE in sentence for sentence in found.warnings)
    assert found.typicality_percentile < 1.0


def test_a_sphere_is_flagged(hippocampus):
    index = np.indices((30, 30, 30)) - 15
    found = answer(hippocampus, (index**2).sum(axis=0) < 81, Grid((30, 30, 30), np.eye(4)), "orthogonal")
    assert any(UNLIKE in sentence for sentence in found.warnings)


def test_hippocampi_are_not_flagged(hippocampus, shared_data):
    cases = load_cohort(CohortName.HIPPOCAMPUS, shared_data, CohortOptions()).test[:10]
    answers = [answer(hippocampus, case.mask, case.grid, "orthogonal") for case in cases]
    flagged = [found for found in answers if any(UNLIKE in sentence for sentence in found.warnings)]
    assert len(flagged) <= 1


@pytest.mark.parametrize("regime", ["orthogonal", "thin"])
def test_hippocampi_of_the_other_side_are_flagged_with_the_way_out(hippocampus, shared_data, regime):
    cases = load_cohort(CohortName.HIPPOCAMPUS, shared_data, CohortOptions()).test[:6]
    answers = [answer(hippocampus, case.mask[::-1].copy(), case.grid, regime) for case in cases]
    told = [found for found in answers if any("mirror=auto" in sentence for sentence in found.warnings)]
    assert len(told) >= 5
    assert all(any(UNLIKE in sentence for sentence in found.warnings) for found in told)
