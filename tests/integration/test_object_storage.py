"""Files, results and jobs over storage that speaks S3, and the same laws for the folder."""

import json
import uuid

import pytest

from service.adapters.blob_results import BlobResultStore
from service.adapters.blobs import FolderBlobs
from service.adapters.s3 import S3Blobs
from service.errors import UnknownResult
from tests.integration.test_jobs import JOBS, form, members
from tests.job_parts import ended, working
from tests.object_storage import BUCKET, KEYS, is_installed, object_storage
from tests.service_parts import app_for, mask_parts, outcome_of, running


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory):
    if not is_installed():
        pytest.skip("no OpenStack Swift beside the tests (pip install swift)")
    with pytest.MonkeyPatch.context() as environment, object_storage(tmp_path_factory.mktemp("swift")) as address:
        for name, value in KEYS.items():
            environment.setenv(name, value)
        yield address


@pytest.fixture(params=["folder", "bucket"])
def blobs(request, tmp_path):
    if request.param == "folder":
        return FolderBlobs(tmp_path / "files")
    return S3Blobs(f"s3://{BUCKET}/{uuid.uuid4().hex}", request.getfixturevalue("endpoint"))


def test_what_is_put_is_got_listed_and_deleted(blobs, tmp_path):
    blobs.put("a/b/one", b"1")
    blobs.put("a/b/one", b"2")
    (tmp_path / "file").write_bytes(b"3" * 100_000)
    with (tmp_path / "file").open("rb") as file:
        file.read(7)
        blobs.put_file("a/c/two", file)
    assert (blobs.get("a/b/one"), len(blobs.get("a/c/two"))) == (b"2", 100_000)
    assert set(blobs.list("a/")) == {"a/b/one", "a/c/two"}
    assert blobs.exists("a/b/one")
    assert set(blobs.folders("a/")) == {"b", "c"}
    assert list(blobs.folders("nothing/")) == []
    blobs.delete("a/b/")
    assert not blobs.exists("a/b/one")
    assert set(blobs.list("a/")) == {"a/c/two"}
    assert list(blobs.list("nothing/")) == []
    with pytest.raises(FileNotFoundError):
        blobs.get("a/b/one")


def test_results_survive_and_expire(blobs):
    now = [1000.0]
    store = BlobResultStore(blobs, lifetime_s=10.0, clock=lambda: now[0])
    outcome = outcome_of()
    kept, other = store.save(outcome), store.save(outcome, str(uuid.uuid4()))
    assert store.load(kept.id).outcome.reconstruction.volume_ml == outcome.reconstruction.volume_ml
    store.delete(other.id)
    now[0] = 1010.0
    for identifier in (kept.id, other.id, "../etc", str(uuid.uuid4())):
        with pytest.raises(UnknownResult):
            store.load(identifier)
    assert store.sweep() == 2
    assert list(blobs.list("results/")) == []


@pytest.mark.parametrize("looked_at", [1010.3, 1010.7, 1010.71, 1011.0])
def test_a_result_that_ends_between_two_seconds_is_removed_whenever_it_is_looked_for(blobs, looked_at):
    now = [1000.7]
    store = BlobResultStore(blobs, lifetime_s=10.0, clock=lambda: now[0])
    store.save(outcome_of())
    for now[0] in (looked_at, 1012.0):
        store.sweep()
    assert [*blobs.list("results/"), *blobs.list("expiry/")] == []


def test_a_result_that_was_saved_again_lives_as_long_as_it_says(blobs):
    now = [1000.0]
    store = BlobResultStore(blobs, lifetime_s=100.0, clock=lambda: now[0])
    identifier = store.save(outcome_of()).id
    now[0] = 1090.0
    store.save(outcome_of(), identifier)
    now[0] = 1101.0
    assert store.sweep() == 0
    assert store.load(identifier).id == identifier
    now[0] = 1190.0
    assert store.sweep() == 1
    assert list(blobs.list("expiry/")) == []


def test_storage_that_does_not_answer_is_a_failure_of_the_medium(endpoint):
    assert endpoint
    with pytest.raises(OSError, match="storage"):
        S3Blobs(f"s3://{BUCKET}", "http://127.0.0.1:9").get("a")


def test_jobs_and_results_over_a_bucket(endpoint, tmp_path):
    app = app_for(tmp_path, storage_url=f"s3://{BUCKET}/service", storage_endpoint=endpoint)
    with running(app) as client, working(app):
        summary = ended(client, client.post(JOBS, files=form(kind="samples", count=5)).headers["location"])
        files = members(client.get(summary["links"]["result"]))
        assert len(json.loads(files["manifest.json"])["samples"]) == 5
        accepted = client.post("/v1/reconstructions", files=mask_parts(), headers={"Prefer": "respond-async"})
        result = ended(client, accepted.headers["location"])["links"]["result"]
        assert client.get(f"{result}/mesh?format=stl").status_code == 200
        assert client.delete(result).status_code == 204
        assert client.get(result).status_code == 404
    assert not (tmp_path / "files").exists()
