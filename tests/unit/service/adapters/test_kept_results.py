"""The laws of both stores of results: in folders of a disk, and as files by key."""

import io
import json
import uuid

import pytest

from service.adapters.archive import MESH, STATE, SUMMARY
from service.adapters.blob_results import BlobResultStore
from service.adapters.blobs import FolderBlobs
from service.adapters.result_store import DiskResultStore
from service.errors import Overloaded, StoreFull, UnknownResult
from service.observability import make_log
from tests.service_parts import outcome_of

LIFETIME_S = 100.0


class Clock:
    def __init__(self):
        self.now = 1_700_000_000.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def log():
    return io.StringIO()


@pytest.fixture
def folder(tmp_path):
    """Where results lie, each in a folder of its name."""
    return tmp_path / "results"


@pytest.fixture(params=["disk", "blobs"])
def store(request, folder, clock, log):
    shared = {"lifetime_s": LIFETIME_S, "clock": clock, "log": make_log("debug", log)}
    if request.param == "disk":
        return DiskResultStore(folder, max_bytes=10**9, **shared)
    return BlobResultStore(FolderBlobs(folder.parent), **shared)


def with_byte(archive, place, value):
    """The ZIP with another byte in each entry of its list of members."""
    return b"PK\x01\x02".join(
        [archive.split(b"PK\x01\x02")[0]]
        + [entry[: place - 4] + bytes([value]) + entry[place - 3 :] for entry in archive.split(b"PK\x01\x02")[1:]]
    )


def told(log):
    return [json.loads(line) for line in log.getvalue().splitlines()]


def test_what_is_saved_is_there_until_it_is_deleted(store):
    outcome = outcome_of()
    kept = store.save(outcome)
    assert store.load(kept.id).outcome.reconstruction.volume_ml == outcome.reconstruction.volume_ml
    assert store.has(kept.id)
    store.delete(kept.id)
    assert not store.has(kept.id)
    for again in (store.load, store.delete):
        with pytest.raises(UnknownResult):
            again(kept.id)


def test_what_has_expired_is_gone_before_it_is_swept_and_after(store, clock, folder):
    kept = store.save(outcome_of())
    clock.now += LIFETIME_S
    for _ in range(2):
        assert not store.has(kept.id)
        for ask in (store.load, store.delete):
            with pytest.raises(UnknownResult):
                ask(kept.id)
        store.sweep()
    assert not (folder / kept.id).exists()


@pytest.mark.parametrize(
    "spelled",
    [
        str.upper,
        lambda name: f"{{{name}}}",
        lambda name: f"urn:uuid:{name}",
        lambda name: name.replace("-", ""),
        lambda name: f"{name}\n",
        lambda name: f"../results/{name}",
        lambda _: "\0",
        lambda _: "",
    ],
    ids=["upper case", "braces", "urn", "without dashes", "line", "path", "no text", "nothing"],
)
def test_a_result_has_one_name(store, spelled):
    kept = store.save(outcome_of())
    other = spelled(kept.id)
    assert not store.has(other)
    for ask in (store.load, store.delete):
        with pytest.raises(UnknownResult):
            ask(other)
    assert store.has(kept.id)


@pytest.mark.parametrize("content", ["null", "[]", "0", "{", '{"archive": 2}', "[" * 100_000, "other", "for ever"])
def test_a_damaged_summary_is_an_unknown_result_and_told_once(store, folder, log, content):
    kept = store.save(outcome_of())
    summary = folder / kept.id / SUMMARY
    document = json.loads(summary.read_text())
    changes = {"other": {"archive": 99}, "for ever": {"expires": float("inf")}}
    summary.write_text(json.dumps({**document, **changes[content]}) if content in changes else content)
    for _ in range(3):
        assert not store.has(kept.id)
        with pytest.raises(UnknownResult):
            store.load(kept.id)
    (entry,) = told(log)
    assert (entry["event"], entry["result"]) == ("damaged result", kept.id)


@pytest.mark.parametrize("name", [STATE, MESH])
@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"junk",
        lambda content: content[: len(content) // 2],
        lambda content: content.replace(b"{'descr'", b"{'descr("),
        lambda content: with_byte(content, 10, 99),
        lambda content: with_byte(content, 8, 1),
    ],
    ids=["other", "cut off", "header", "method", "password"],
)
def test_damaged_arrays_are_an_unknown_result_and_told_once(store, folder, log, name, damage):
    kept = store.save(outcome_of())
    file = folder / kept.id / name
    content = file.read_bytes()
    damaged = damage(content)
    assert damaged != content
    file.write_bytes(damaged)
    for _ in range(2):
        with pytest.raises(UnknownResult):
            store.load(kept.id)
    (entry,) = told(log)
    assert (entry["event"], entry["result"]) == ("damaged result", kept.id)
    assert str(folder) not in log.getvalue()


def test_what_is_not_there_is_no_damage(store, log):
    with pytest.raises(UnknownResult):
        store.load(str(uuid.uuid4()))
    assert told(log) == []


class AwayBlobs(FolderBlobs):
    """Storage that takes and gives nothing while it is away."""

    away = False

    def put(self, key, data):
        self._answer()
        super().put(key, data)

    def put_file(self, key, file):
        self._answer()
        super().put_file(key, file)

    def get(self, key):
        self._answer()
        return super().get(key)

    def _answer(self):
        if self.away:
            raise OSError("The object storage does not answer.")


def test_storage_that_is_away_is_work_for_later(tmp_path):
    blobs = AwayBlobs(tmp_path)
    store = BlobResultStore(blobs, lifetime_s=LIFETIME_S)
    kept = store.save(outcome_of())
    blobs.away = True
    with pytest.raises(StoreFull):
        store.save(outcome_of())
    for ask in (store.load, store.has, store.delete):
        with pytest.raises(Overloaded):
            ask(kept.id)
    blobs.away = False
    assert store.load(kept.id).id == kept.id


class SmallBlobs(FolderBlobs):
    """Storage that gives summaries alone."""

    def get(self, key):
        assert key.endswith(SUMMARY)
        return super().get(key)


def test_a_result_is_deleted_without_being_read(tmp_path):
    store = BlobResultStore(SmallBlobs(tmp_path), lifetime_s=LIFETIME_S)
    kept = store.save(outcome_of())
    store.delete(kept.id)
    assert not (tmp_path / "results" / kept.id).exists()


@pytest.mark.parametrize("key", ["expiry/stray", "expiry/1/2/3", "expiry/soon/name", "expiry/000000000001/.."])
def test_what_is_no_marker_is_left_alone_by_a_sweep(tmp_path, clock, key):
    store = BlobResultStore(FolderBlobs(tmp_path), lifetime_s=LIFETIME_S, clock=clock)
    kept = store.save(outcome_of())
    stray = tmp_path / (key if not key.endswith("..") else f"{key}.")
    stray.parent.mkdir(exist_ok=True, parents=True)
    stray.write_bytes(b"")
    clock.now += LIFETIME_S
    assert store.sweep() == 1
    assert stray.exists()
    assert not store.has(kept.id)


def test_a_folder_that_was_removed_is_made_again(tmp_path, clock):
    store = DiskResultStore(tmp_path / "results", lifetime_s=LIFETIME_S, max_bytes=10**9, clock=clock)
    (tmp_path / "results").rmdir()
    assert store.has(store.save(outcome_of()).id)


def test_a_result_that_is_not_taken_leaves_the_one_that_it_would_replace(tmp_path, clock):
    folder = tmp_path / "results"
    kept = DiskResultStore(folder, lifetime_s=LIFETIME_S, max_bytes=10**9, clock=clock).save(outcome_of())
    full = DiskResultStore(folder, lifetime_s=LIFETIME_S, max_bytes=10, clock=clock)
    with pytest.raises(StoreFull):
        full.save(outcome_of(), kept.id)
    assert full.load(kept.id).id == kept.id


def test_a_result_takes_the_room_of_the_one_that_it_replaces(tmp_path, clock):
    folder = tmp_path / "results"
    probe = DiskResultStore(folder, lifetime_s=LIFETIME_S, max_bytes=10**9, clock=clock)
    first = probe.save(outcome_of()).id
    size = sum(file.stat().st_size for file in (folder / first).iterdir())
    store = DiskResultStore(folder, lifetime_s=LIFETIME_S, max_bytes=int(2.5 * size), clock=clock)
    second = store.save(outcome_of()).id
    store.save(outcome_of(), second)
    assert store.has(first)
    assert store.has(second)
