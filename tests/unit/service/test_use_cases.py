"""Use cases on domain types, without HTTP."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.errors import InvalidParameter, TooLarge
from model.inference.one_body import OCCUPIED
from model.inference.surface import canonical_box
from service import use_cases
from service.errors import NotComputed
from service.model_registry import ModelRegistry
from tests.analytic_model import ellipsoid_model
from tests.mask_stacks import stack_of
from tests.service_parts import NAME, outcome_of

PLENTY = 10**6


@pytest.fixture(scope="module")
def registry():
    return ModelRegistry({NAME: ellipsoid_model(NAME)})


@given(st.integers(0, use_cases.MAX_SEED), st.integers(1, 50))
def test_a_batch_counts_on_from_its_seed(seed, count):
    if seed + count - 1 > use_cases.MAX_SEED:
        with pytest.raises(InvalidParameter):
            use_cases.batch_seeds(seed, count, 50)
    else:
        assert list(use_cases.batch_seeds(seed, count, 50)) == [seed + i for i in range(count)]


@pytest.mark.parametrize(
    ("seed", "count", "error"), [(0, 0, InvalidParameter), (0, 51, TooLarge), (-1, 1, InvalidParameter)]
)
def test_batches_out_of_range_are_refused(seed, count, error):
    with pytest.raises(error):
        use_cases.batch_seeds(seed, count, 50)


def test_volumes_share_grid_and_threshold(registry):
    outcome = outcome_of()
    probability, labels, entropy = (
        compute(registry, outcome, None, PLENTY)
        for compute in (use_cases.probability_map, use_cases.segmentation, use_cases.entropy_map)
    )
    for volume in (probability, labels, entropy):
        assert volume.grid is outcome.grid
        assert volume.array.shape == outcome.grid.shape
    np.testing.assert_array_equal(labels.array == 1, probability.array >= OCCUPIED)
    assert entropy.array.max() <= np.log(2) + 1e-6


def test_an_answer_of_too_many_voxels_is_refused_before_it_is_made(registry):
    outcome = replace(outcome_of(), grid=replace(outcome_of().grid, shape=(10**6, 10**6, 10**6)))
    with pytest.raises(TooLarge):
        use_cases.segmentation(registry, outcome, None, PLENTY)


def test_a_result_of_another_version_of_the_model_is_not_evaluated(registry):
    with pytest.raises(NotComputed):
        use_cases.segmentation(registry, replace(outcome_of(), model_digest="0" * 64), None, PLENTY)
    with pytest.raises(NotComputed):
        use_cases.segmentation(registry, replace(outcome_of(), model_name="spleen"), None, PLENTY)


def test_uncertainty_that_was_not_asked_for_is_not_made_up(registry):
    outcome = outcome_of(uncertain=False)
    with pytest.raises(NotComputed):
        use_cases.surface_sd(outcome)
    with pytest.raises(NotComputed):
        use_cases.entropy_map(registry, outcome, None, PLENTY)


@pytest.mark.parametrize("spacing_mm", [0.5, 1.0, 3.0])
def test_the_voxel_limit_holds_for_the_models_box(spacing_mm):
    model = ellipsoid_model(NAME)
    needed = int(np.prod(np.ceil(2 * canonical_box(model) / spacing_mm) + 1))
    use_cases.draw(model, 1, 1.0, spacing_mm, needed)
    with pytest.raises(TooLarge):
        use_cases.draw(model, 1, 1.0, spacing_mm, needed - 1)


def test_what_is_drawn_around_a_large_object_keeps_the_voxel_limit_too(registry):
    needed = int(np.prod(np.ceil(2 * canonical_box(registry.get(NAME))) + 1))
    for size, refused in ((0.5, False), (1.0, False), (12.0, True)):
        outcome = sized(outcome_of(), size)
        for ask in (use_cases.posterior, lambda *values: use_cases.way_between(values[0], values[1], *values[1:])):
            if refused:
                with pytest.raises(TooLarge, match="12 times as large"):
                    ask(registry, outcome, 1.0, needed)
            else:
                ask(registry, outcome, 1.0, needed)


def sized(outcome, size):
    """The outcome for an object so many times as large as the model's."""
    answer = outcome.reconstruction
    fits = tuple(replace(fit, pose=replace(fit.pose, log_scale=-np.log(size))) for fit in answer.state.fits)
    return replace(outcome, reconstruction=replace(answer, state=replace(answer.state, fits=fits)))


def test_the_masks_of_one_drawing_share_one_budget():
    stack = stack_of(np.ones((10, 10, 10), bool))
    read = lambda data, part, labels: (stack,)  # noqa: E731
    assert len(use_cases.stacks_of(read, [b""] * 3, None, 3000)) == 3
    with pytest.raises(TooLarge, match=r"up to mask\[2\]") as refused:
        use_cases.stacks_of(read, [b""] * 8, None, 2999)
    assert refused.value.part == "mask[2]"
