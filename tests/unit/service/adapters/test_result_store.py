"""Results on disk: exact, complete or absent, and never served after their time."""

import dataclasses
import json
import stat

import numpy as np
import pytest

from model.inference.mask_stack import MaskStack
from model.inference.reconstruction import Options, reconstruct
from model.inference.uncertainty import occupancy
from service.adapters.archive import MESH, STATE, SUMMARY
from service.adapters.result_store import DiskResultStore
from service.errors import StoreFull, UnknownResult
from tests.analytic_model import ellipsoid_model
from tests.completing import BallCompleter, completing
from tests.service_parts import outcome_of, sparse_ellipsoid


class Clock:
    def __init__(self):
        self.now = 1_700_000_000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def store(tmp_path, clock):
    return DiskResultStore(tmp_path / "r", lifetime_s=100.0, max_bytes=10**9, clock=clock)


def assert_same(left, right):
    assert type(left) is type(right)
    if dataclasses.is_dataclass(left):
        for field in dataclasses.fields(left):
            assert_same(getattr(left, field.name), getattr(right, field.name))
    elif isinstance(left, dict):
        assert left.keys() == right.keys()
        for name in left:
            assert_same(left[name], right[name])
    elif isinstance(left, tuple):
        assert len(left) == len(right)
        for one, other in zip(left, right, strict=True):
            assert_same(one, other)
    elif isinstance(left, np.ndarray):
        np.testing.assert_array_equal(left, right, strict=True)
    else:
        assert left == right


@pytest.mark.parametrize("uncertain", [True, False])
def test_what_is_kept_comes_back_exactly(store, uncertain):
    outcome = outcome_of(uncertain=uncertain)
    kept = store.save(outcome)
    assert_same(store.load(kept.id), kept)
    assert_same(kept.outcome, outcome)


def test_a_result_keeps_the_world_that_it_is_told_in(store, tmp_path):
    outcome = outcome_of()
    told = dataclasses.replace(outcome, reconstruction=dataclasses.replace(outcome.reconstruction, space="LPS"))
    kept = store.save(told)
    assert_same(store.load(kept.id).outcome, told)
    (summary,) = (tmp_path / "r").rglob(SUMMARY)
    document = json.loads(summary.read_text())
    del document["reconstruction"]["space"]  # as results of earlier versions are
    summary.write_text(json.dumps(document))
    assert store.load(kept.id).outcome.reconstruction.space == "RAS"


@pytest.mark.parametrize("uncertainty", ["laplace", "ensemble"])
def test_a_field_that_was_completed_and_follows_its_contours_comes_back_exactly(store, uncertainty):
    model = completing(ellipsoid_model(), BallCompleter(9.0), 0.5)
    values, grid = sparse_ellipsoid()
    stack = MaskStack("mask[0]", grid, values > 0, np.zeros(values.shape, bool))
    answer = reconstruct(model, [stack], Options(annotated="auto", uncertainty=uncertainty))
    kept = store.save(dataclasses.replace(outcome_of(), reconstruction=answer))
    loaded = store.load(kept.id).outcome.reconstruction
    assert loaded.state.fits[0].discrepancy.levels.completion is not None
    np.testing.assert_array_equal(occupancy(model, loaded.state, grid), occupancy(model, answer.state, grid))


def test_results_survive_a_restart(store, tmp_path, clock):
    kept = store.save(outcome_of())
    again = DiskResultStore(tmp_path / "r", lifetime_s=1.0, max_bytes=10**9, clock=clock)
    assert_same(again.load(kept.id), kept)


def test_identifiers_are_random(store):
    assert len({store.save(outcome_of()).id for _ in range(5)}) == 5


def test_an_expired_result_is_not_served_before_it_is_swept_nor_after(store, clock, tmp_path):
    kept = store.save(outcome_of())
    clock.now += 99.0
    store.load(kept.id)
    clock.now += 1.0
    with pytest.raises(UnknownResult):
        store.load(kept.id)
    assert store.sweep() == 1
    assert list((tmp_path / "r").iterdir()) == []
    with pytest.raises(UnknownResult):
        store.delete(kept.id)


def test_sweeping_leaves_what_still_lives(store, clock):
    old = store.save(outcome_of())
    clock.now += 60.0
    young = store.save(outcome_of())
    clock.now += 60.0
    assert store.sweep() == 1
    assert store.load(young.id).id == young.id
    with pytest.raises(UnknownResult):
        store.load(old.id)


def test_a_deleted_result_is_gone(store, tmp_path):
    kept = store.save(outcome_of())
    store.delete(kept.id)
    for again in (store.load, store.delete):
        with pytest.raises(UnknownResult):
            again(kept.id)
    assert list((tmp_path / "r").iterdir()) == []


@pytest.mark.parametrize(
    "identifier", ["", "..", "../x", "a/b", "0" * 36, "%2e%2e", "00000000-0000-4000-8000-000000000000\n"]
)
def test_other_identifiers_never_reach_the_disk(store, identifier):
    with pytest.raises(UnknownResult):
        store.load(identifier)
    with pytest.raises(UnknownResult):
        store.delete(identifier)


@pytest.mark.parametrize("name", [SUMMARY, STATE, MESH])
@pytest.mark.parametrize("damage", [lambda file: file.unlink(), lambda file: file.write_bytes(b"junk")])
def test_a_damaged_result_is_unknown(store, tmp_path, name, damage):
    kept = store.save(outcome_of())
    damage(tmp_path / "r" / kept.id / name)
    with pytest.raises(UnknownResult):
        store.load(kept.id)


def test_another_format_is_not_read(store, tmp_path):
    kept = store.save(outcome_of())
    file = tmp_path / "r" / kept.id / SUMMARY
    file.write_text(json.dumps({**json.loads(file.read_text()), "archive": 99}))
    with pytest.raises(UnknownResult):
        store.load(kept.id)


@pytest.fixture
def size(tmp_path, clock):
    """Bytes of a result on disk."""
    probe = DiskResultStore(tmp_path / "p", lifetime_s=100.0, max_bytes=10**9, clock=clock)
    return sum(file.stat().st_size for file in (tmp_path / "p" / probe.save(outcome_of()).id).iterdir())


def test_the_oldest_make_room_for_the_new(tmp_path, clock, size):
    store = DiskResultStore(tmp_path / "r", lifetime_s=100.0, max_bytes=int(2.5 * size), clock=clock)
    kept = []
    for _ in range(3):
        kept.append(store.save(outcome_of()).id)
        clock.now += 1.0
    with pytest.raises(UnknownResult):
        store.load(kept[0])
    assert [store.load(identifier).id for identifier in kept[1:]] == kept[1:]


@pytest.mark.parametrize("passed_s", [1.0, -3600.0], ids=["a second later", "with a clock set back"])
def test_results_of_other_processes_make_room_too(tmp_path, clock, size, passed_s):
    place = tmp_path / "r"
    mine, theirs = (
        DiskResultStore(place, lifetime_s=10_000.0, max_bytes=most, clock=clock) for most in (int(2.5 * size), 10**9)
    )
    first = mine.save(outcome_of()).id
    for _ in range(2):
        clock.now += 0.1
        theirs.save(outcome_of())
    clock.now += passed_s
    mine.save(outcome_of())
    assert len(list(place.iterdir())) == 2
    with pytest.raises(UnknownResult):
        theirs.load(first)


def test_a_result_larger_than_the_store_is_refused_and_leaves_nothing(tmp_path, clock):
    store = DiskResultStore(tmp_path / "r", lifetime_s=100.0, max_bytes=10, clock=clock)
    with pytest.raises(StoreFull):
        store.save(outcome_of())
    assert list((tmp_path / "r").iterdir()) == []


def test_only_the_owner_can_read_results(store, tmp_path):
    kept = store.save(outcome_of())
    for folder in (tmp_path / "r", tmp_path / "r" / kept.id):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
