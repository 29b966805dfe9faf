"""Jobs over HTTP: asked for, followed, cancelled and fetched, by a real server with a real worker."""

import io
import json
import zipfile

import pytest

from tests.analytic_model import ellipsoid_model
from tests.dicom_parts import file_bytes, mr_series, seg_of
from tests.job_parts import ended, working
from tests.service_parts import NAME, app_for, mask_bytes, mask_parts, problem, running, sparse_ellipsoid
from tests.waiting import until

JOBS = "/v1/jobs"


@pytest.fixture(scope="module")
def app(tmp_path_factory):
    return app_for(tmp_path_factory.mktemp("jobs"), max_job_samples=1000)


@pytest.fixture(scope="module")
def client(app):
    with running(app) as client, working(app):
        yield client


def form(**parts):
    return {name: (None, str(value)) for name, value in parts.items()}


def archive_of(**masks: bytes) -> bytes:
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in masks.items():
            archive.writestr(f"masks/{name}" if "." in name else f"masks/{name}.nii", data)
        archive.writestr("masks/read.me", "no mask")
    return target.getvalue()


def members(response):
    assert response.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(response.content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_bulk_samples_are_those_of_single_requests(client):
    accepted = client.post(JOBS, files=form(kind="samples", count=9, seed=4, format="ply"))
    assert accepted.status_code == 202
    summary = ended(client, accepted.headers["location"])
    assert (summary["state"], summary["done"], summary["total"]) == ("done", 9, 9)
    files = members(client.get(summary["links"]["result"]))
    manifest = json.loads(files.pop("manifest.json"))
    assert [entry["seed"] for entry in manifest["samples"]] == list(range(4, 13))
    assert list(files) == [entry["file"] for entry in manifest["samples"]]
    assert files[f"{NAME}-7.ply"] == client.get(f"/v1/models/{NAME}/samples/7?format=ply").content


def test_each_mask_of_an_archive_is_reconstructed_and_one_at_fault_stops_no_other(client):
    drawing = file_bytes(seg_of(mr_series(), sparse_ellipsoid()[0]))
    archive = archive_of(a=mask_bytes(), b=b"no image", c=mask_bytes((12.0, 9.0, 8.0)), **{"d.dcm": drawing})
    parts = {**form(kind="reconstructions", uncertainty="none", format="ply"), "archive": ("masks.zip", archive)}
    summary = ended(client, client.post(JOBS, files=parts).headers["location"])
    assert (summary["state"], summary["done"]) == ("done", 4)
    files = members(client.get(summary["links"]["result"]))
    first, second, third, fourth = json.loads(files["manifest.json"])["reconstructions"]
    assert [entry["mask"] for entry in (first, second, third, fourth)] == [
        *(f"masks/{name}.nii" for name in "abc"),
        "masks/d.dcm",
    ]
    assert "mask[0]" in second["problem"]
    assert second["problem_type"] == "urn:morphoflow:problem:unreadable-image"
    assert (first["summary"]["space"], fourth["summary"]["space"]) == ("RAS", "LPS")
    assert b"comment space LPS" in files[fourth["file"]]
    manifest = json.loads(files["manifest.json"])
    assert "space" not in manifest
    assert manifest["models"] == [f"{NAME}@1.0.0"]
    assert manifest["left_out"] == ["masks/read.me"]
    assert files[first["file"]] != files[third["file"]]
    assert first["summary"]["fit"]["converged"]


def test_a_reconstruction_may_be_asked_for_without_waiting(client):
    waited = client.post("/v1/reconstructions", files=mask_parts(), data={"seed": "3"}).json()
    accepted = client.post(
        "/v1/reconstructions", files=mask_parts(), data={"seed": "3"}, headers={"Prefer": "respond-async, wait=1"}
    )
    assert accepted.status_code == 202
    assert accepted.headers["preference-applied"] == "respond-async"
    summary = ended(client, accepted.headers["location"])
    result = client.get(f"{summary['links']['self']}/result", follow_redirects=True).json()
    assert result["links"]["self"] == summary["links"]["result"]
    assert (summary["problem"], summary["problem_type"], summary["problem_status"]) == (None, None, None)
    assert result["volume_ml"] == waited["volume_ml"]


def test_an_input_at_fault_fails_the_job_with_its_sentence(client):
    accepted = client.post("/v1/reconstructions", files=mask_parts(b"no"), headers={"Prefer": "respond-async"})
    summary = ended(client, accepted.headers["location"])
    assert summary["state"] == "failed"
    assert "mask[0]" in summary["problem"]
    refused = client.get(f"{accepted.headers['location']}/result")
    assert refused.status_code == 409
    assert refused.json()["detail"].endswith(summary["problem"])
    waited = problem(client.post("/v1/reconstructions", files=mask_parts(b"no")), 415)
    for told in (summary, refused.json()):
        assert (told["problem_type"], told["problem_status"]) == (waited["type"], waited["status"])


def test_the_same_key_leads_to_the_same_job_and_another_request_is_refused(client):
    key = {"Idempotency-Key": "one"}
    first = client.post(JOBS, files=form(kind="samples", count=2), headers=key).json()
    again = client.post(JOBS, files=form(kind="samples", count=2), headers=key).json()
    assert first["id"] == again["id"]
    other = client.post(JOBS, files=form(kind="samples", count=3), headers=key)
    assert (other.status_code, other.json()["part"]) == (422, "Idempotency-Key")
    wish = {**key, "Prefer": "respond-async"}
    other = client.post("/v1/reconstructions", files=mask_parts(), data={"model": NAME}, headers=wish)
    assert problem(other, 422)["part"] == "Idempotency-Key"


def test_events_tell_the_progress_to_the_end(client):
    place = client.post(JOBS, files=form(kind="samples", count=12)).json()["links"]
    with client.stream("GET", place["events"]) as response:
        assert response.headers["content-type"].startswith("text/event-stream")
        lines = [line for line in response.iter_lines() if line]
    names = [line.removeprefix("event: ") for line in lines if line.startswith("event: ")]
    told = [json.loads(line.removeprefix("data: ")) for line in lines if line.startswith("data: ")]
    assert set(names[:-1]) <= {"progress"}
    assert names[-1] == "end"
    assert [summary["done"] for summary in told] == sorted(summary["done"] for summary in told)
    assert told[-1]["state"] == "done"


def test_a_cancelled_job_stops_and_an_ended_one_is_forgotten(client):
    place = client.post(JOBS, files=form(kind="samples", count=1000)).headers["location"]
    assert client.delete(place).json()["state"] == "cancelled"
    problem = client.get(f"{place}/result").json()
    assert problem["type"] == "urn:morphoflow:problem:cancelled"
    assert client.delete(place).status_code == 204
    assert client.get(place).status_code == 404


@pytest.mark.parametrize(
    ("parts", "part", "status"),
    [
        ({"kind": "samples", "count": 1001}, "count", 413),
        ({"kind": "samples", "model": "hip"}, "model", 422),
        ({"kind": "samples", "mirror": "auto"}, "mirror", 422),
        ({"kind": "reconstructions"}, "archive", 422),
        ({"kind": "reconstructions", "count": 3}, "count", 422),
        ({"kind": "other"}, "kind", 422),
        ({"kind": "samples", "colour": "red"}, "colour", 422),
    ],
)
def test_requests_at_fault_are_refused_by_part(client, parts, part, status):
    answer = client.post(JOBS, files=form(**parts))
    assert (answer.status_code, answer.json()["part"]) == (status, part)


def test_a_job_is_forgotten_with_its_result_and_all_that_a_running_part_still_writes(client, app):
    accepted = client.post("/v1/reconstructions", files=mask_parts(), headers={"Prefer": "respond-async"})
    summary = ended(client, accepted.headers["location"])
    assert client.get(summary["links"]["result"]).status_code == 200
    assert client.delete(summary["links"]["self"]).status_code == 204
    assert client.get(summary["links"]["result"]).status_code == 404

    job = client.post(JOBS, files=form(kind="samples", count=1000, format="npz")).json()
    blobs, folder = app.state.services.blobs, f"jobs/{job['id']}/"
    until(lambda: list(blobs.list(folder)))
    assert client.delete(job["links"]["self"]).json()["state"] == "cancelled"
    assert client.delete(job["links"]["self"]).status_code == 204
    ended(client, client.post(JOBS, files=form(kind="samples", count=2)).headers["location"])  # the worker is free
    assert list(blobs.list(folder)) == []


def test_a_damaged_mask_of_an_archive_is_an_entry_and_stops_no_other(client):
    archive = bytearray(archive_of(a=mask_bytes(), b=mask_bytes((12.0, 9.0, 8.0))))
    archive[archive.rindex(b"masks/b.nii", 0, archive.index(b"PK\x01\x02")) + 500] ^= 0xFF  # its checksum is wrong now
    parts = {**form(kind="reconstructions", uncertainty="none"), "archive": ("masks.zip", bytes(archive))}
    summary = ended(client, client.post(JOBS, files=parts).headers["location"])
    assert (summary["state"], summary["done"]) == ("done", 2)
    first, second = json.loads(members(client.get(summary["links"]["result"]))["manifest.json"])["reconstructions"]
    assert first["summary"]["fit"]["converged"]
    assert second == {
        "mask": "masks/b.nii",
        "problem": "The mask is damaged in the archive; pack it anew.",
        "problem_type": "urn:morphoflow:problem:unreadable-image",
    }


@pytest.mark.parametrize(
    ("archive", "status"),
    [(b"hello", 422), (archive_of(a=b"1")[:-40], 422), (archive_of(a=bytes(60_000), b=bytes(60_000)), 413)],
    ids=["no ZIP", "its end is gone", "too large together"],
)
def test_an_archive_that_cannot_be_unpacked_becomes_no_job(tmp_path, archive, status):
    with running(app_for(tmp_path, max_job_bytes=100_000)) as client:
        answer = client.post(JOBS, files={**form(kind="reconstructions"), "archive": ("masks.zip", archive)})
    assert (answer.status_code, answer.json()["part"]) == (status, "archive")


def test_an_archive_without_masks_fails(client):
    parts = {**form(kind="reconstructions"), "archive": ("masks.zip", archive_of())}
    summary = ended(client, client.post(JOBS, files=parts).headers["location"])
    assert summary["state"] == "failed"
    assert "archive" in summary["problem"]


def test_as_many_jobs_wait_as_may(tmp_path):
    with running(app_for(tmp_path, max_jobs=1)) as client:
        assert client.post(JOBS, files=form(kind="samples")).status_code == 202
        refused = client.post(JOBS, files=form(kind="samples"))
        assert refused.status_code == 503
        assert int(refused.headers["retry-after"]) > 0
        figures = client.get("/metrics").text
        assert "morphoflow_jobs_waiting_parts 0.0" in figures
        assert "morphoflow_jobs_unfinished 1.0" in figures


def test_a_job_whose_result_was_deleted_says_so_and_leads_nowhere(client):
    accepted = client.post("/v1/reconstructions", files=mask_parts(), headers={"Prefer": "respond-async"})
    place = accepted.headers["location"]
    assert client.delete(ended(client, place)["links"]["result"]).status_code == 204
    summary = client.get(place).json()
    assert (summary["state"], summary["links"]["result"]) == ("done", None)
    assert "deleted" in summary["problem"]
    told = problem(client.get(f"{place}/result", follow_redirects=False), 404)
    assert (summary["problem_type"], summary["problem_status"]) == (told["type"], told["status"])
    assert (told["type"], told["detail"]) == ("urn:morphoflow:problem:unknown-result", summary["problem"])
    assert client.delete(place).status_code == 204


def test_a_job_whose_files_are_gone_leads_nowhere(client, app):
    summary = ended(client, client.post(JOBS, files=form(kind="samples", count=2)).headers["location"])
    app.state.services.blobs.delete(f"jobs/{summary['id']}/")
    told = problem(client.get(summary["links"]["result"]), 404)
    assert told["type"].endswith("unknown-result")
    assert "deleted" in told["detail"]


def test_a_request_sent_again_is_answered_with_its_job_though_its_model_is_gone(tmp_path):
    def sent(client):
        key = {"Idempotency-Key": "one"}
        samples = client.post(JOBS, files=form(kind="samples", count=2, model=NAME), headers=key)
        wish = {"Idempotency-Key": "two", "Prefer": "respond-async"}
        single = client.post("/v1/reconstructions", files=mask_parts(), data={"model": NAME}, headers=wish)
        return [(answer.status_code, answer.headers["location"]) for answer in (samples, single)]

    with running(app_for(tmp_path)) as client:
        first = sent(client)
    with running(app_for(tmp_path, ellipsoid_model("other"))) as client:
        assert sent(client) == first
        assert problem(client.post(JOBS, files=form(kind="samples", count=2, model=NAME)), 422)["part"] == "model"


def test_the_same_key_of_two_clients_is_two_jobs(tmp_path):
    def asked(client, who, count):
        headers = {"Idempotency-Key": "one", "X-API-Key": who}
        return client.post(JOBS, files=form(kind="samples", count=count), headers=headers)

    with running(app_for(tmp_path, api_keys=("a", "b"))) as client:
        mine, theirs = asked(client, "a", 2).json()["id"], asked(client, "b", 3).json()["id"]
        assert mine != theirs
        assert [asked(client, "a", 2).json()["id"], asked(client, "b", 3).json()["id"]] == [mine, theirs]
        assert problem(asked(client, "b", 2), 422)["part"] == "Idempotency-Key"


@pytest.mark.parametrize("name", ["%00", "nothing", "%7Bx%7D"])
def test_a_name_that_is_no_identifier_is_no_job(client, name):
    for path in (f"{JOBS}/{name}", f"{JOBS}/{name}/events", f"{JOBS}/{name}/result"):
        told = problem(client.get(path), 404)
        assert (told["type"], told["part"]) == ("urn:morphoflow:problem:unknown-job", "id")
