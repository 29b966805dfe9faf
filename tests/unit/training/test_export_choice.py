"""What an export fits to the codes of a run, by what a caller chooses and how the run was trained."""

import pytest

from model.errors import InvalidParameter
from training.export_choice import ExportChoice
from training.pruning import PriorParts


def test_a_prior_is_fitted_where_none_was_trained_along_unless_the_caller_says_otherwise():
    assert ExportChoice().parts(stood_still=True) == PriorParts()
    assert ExportChoice().parts(stood_still=False) is None
    for stood_still in (True, False):
        assert ExportChoice(prune=True).parts(stood_still=stood_still) == PriorParts()
        assert ExportChoice(prune=False).parts(stood_still=stood_still) is None


def test_what_is_chosen_of_the_fit_holds():
    found = ExportChoice(least_movement=0.0, least_of_training=0.9).parts(stood_still=True)
    assert found == PriorParts(least_movement=0.0, least_of_training=0.9)


@pytest.mark.parametrize("option", ["least_movement", "least_of_training"])
@pytest.mark.parametrize(("prune", "stood_still"), [(False, True), (None, False)])
def test_a_share_of_what_is_not_fitted_is_refused(option, prune, stood_still):
    with pytest.raises(InvalidParameter, match="Nothing is pruned") as caught:
        ExportChoice(prune, **{option: 0.2}).parts(stood_still=stood_still)
    assert caught.value.part == "prune"


def test_a_cohort_chooses_only_of_a_prior_that_stood_still_and_is_fitted():
    assert ExportChoice(by_cohort=True).parts(stood_still=True) == PriorParts()
    for prune, stood_still in ((False, True), (None, False), (True, False)):
        with pytest.raises(InvalidParameter, match="chooses how much") as caught:
            ExportChoice(prune, by_cohort=True).parts(stood_still=stood_still)
        assert caught.value.part == "cohort"
