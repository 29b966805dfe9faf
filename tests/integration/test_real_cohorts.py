"""The public cohorts as they lie in the data folder; skipped where there is none."""

import numpy as np
import pytest

from model.errors import CohortError
from training.cohorts import CohortName, CohortOptions, load_cohort, read_folder
from training.cohorts.cohort import divided_persons
from training.cohorts.inspect import part_sizes, touches_border
from training.points import cohort_points
from training.sparsify import REGIMES, for_evaluation

SIZES = {
    CohortName.HIPPOCAMPUS: (179, 30),
    CohortName.ADRENAL: (1188, 98),
    CohortName.TALUS: (19, 3),
    CohortName.VERTEBRA: (120, 17),
    CohortName.FEMUR: (23, 5),
}


@pytest.fixture(scope="module")
def cohort(shared_data):
    """Each cohort, read once."""
    read = {}

    def get(name):
        if not (shared_data / name).is_dir():
            pytest.skip(f"the data folder holds no {name}")
        if name not in read:
            read[name] = load_cohort(name, shared_data, CohortOptions())
        return read[name]

    return get


@pytest.mark.parametrize("name", list(CohortName))
def test_splits_are_by_person_and_a_fifth_of_them_is_held_out(cohort, name):
    found = cohort(name)
    training, test = SIZES[name]
    assert (len(found.train) + len(found.validation), len(found.test)) == (training, test)
    assert divided_persons(found.cases) == ()
    persons = {case.person for case in found.train + found.validation}
    held = {case.person for case in found.validation}
    assert len(held) == round(0.2 * len(persons))


@pytest.mark.parametrize("name", list(CohortName))
def test_every_training_mask_is_in_one_piece_or_in_large_ones(cohort, name):
    for case in cohort(name).train:
        sizes = part_sizes(case.mask)
        assert min(sizes) >= 0.05 * max(sizes)


def test_a_mask_that_stands_in_both_splits_is_kept_for_testing_alone(cohort):
    found = cohort(CohortName.HIPPOCAMPUS)
    assert [(refusal.name, refusal.stops) for refusal in found.refused] == [("hippocampus_010", False)]
    assert "hippocampus_011" in {case.name for case in found.test}


def test_hippocampi_with_specks_are_counted(cohort):
    found = cohort(CohortName.HIPPOCAMPUS)
    speckled = [case for case in found.cases if any("speck" in text for text in case.findings)]
    assert sum(case.split == "test" for case in speckled) == 2
    assert len(speckled) == 11


def test_adrenal_glands_that_touch_the_border_are_counted(cohort):
    found = cohort(CohortName.ADRENAL)
    share = np.mean([any("of the crop" in text for text in case.findings) for case in found.cases])
    assert share == pytest.approx(0.095, abs=0.001)


def test_the_other_organ_among_the_hippocampi_is_refused_with_its_reason(shared_data):
    folder = shared_data / "hippocampus"
    if not (folder / "dirty").is_dir():
        pytest.skip("the data folder holds no hippocampus/dirty")
    with pytest.raises(CohortError, match=r"hippocampus_281: it does not belong to the cohort: .*volume 55\.8 mL"):
        read_folder(folder, CohortOptions())
    left = read_folder(folder, CohortOptions(skip_refused=True))
    assert [refusal.name for refusal in left.refused if refusal.stops] == ["hippocampus_281"]
    assert len(left.cases) == 209


def test_of_the_vertebrae_only_verse_ships(cohort, shared_data):
    shipped = load_cohort(CohortName.VERTEBRA, shared_data, CohortOptions(shippable_only=True))
    assert len(shipped.cases) == 30
    assert shipped.provenance.shippable
    assert not cohort(CohortName.VERTEBRA).provenance.shippable


@pytest.mark.parametrize("name", list(CohortName))
@pytest.mark.parametrize("regime", REGIMES)
def test_every_test_mask_can_be_drawn(cohort, name, regime):
    for case in cohort(name).test[:10]:
        drawing = for_evaluation(case.mask, case.grid, regime)
        assert len(drawing.planes) >= 2
        assert drawing.stack.foreground.any()


def test_cut_femurs_end_at_their_cut(cohort):
    cases = cohort(CohortName.FEMUR).train[:2]
    assert all(touches_border(case.mask) for case in cases)
    for case, points in zip(cases, cohort_points(cases, "thin", 0), strict=True):
        world = points.points + case.grid.to_world(np.argwhere(case.mask).astype(float)).mean(axis=0)
        index = case.grid.to_index(world)
        beyond = (index < -0.5).any(axis=1) | (index > np.array(case.grid.shape) - 0.5).any(axis=1)
        assert beyond.any()
        assert not points.labels[beyond].any()
