"""What the service refuses, what it never tells, and that no place is lost on the way."""

import io
import json
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace

import httpx
import pytest

from service.app import create_app
from service.model_registry import BrokenModel, ModelRegistry
from service.observability import make_log
from tests.analytic_model import EllipsoidDecoder, ellipsoid_model
from tests.bad_inputs import SECRET
from tests.service_parts import NAME, app_for, gated_model, mask_parts, problem, running, settings_for

RECONSTRUCTIONS = "/v1/reconstructions"
SAMPLES = f"/v1/models/{NAME}/samples"


def chunks(size, count):
    for _ in range(count):
        yield b"x" * size


def test_a_body_is_refused_by_its_declared_length(tmp_path):
    with running(app_for(tmp_path, max_body_bytes=1000)) as client:
        answer = problem(client.post(RECONSTRUCTIONS, files=mask_parts(b"x" * 2000)), 413)
        assert (answer["part"], "1000" in answer["detail"]) == ("body", True)


def test_a_body_without_a_length_is_refused_as_soon_as_it_is_too_long(tmp_path):
    sent = []

    def endless():
        head = b'--b\r\nContent-Disposition: form-data; name="mask"; filename="m"\r\n\r\n'
        yield head
        for chunk in chunks(1000, 100_000):
            sent.append(len(chunk))
            yield chunk

    with running(app_for(tmp_path, max_body_bytes=50_000)) as client:
        headers = {"Content-Type": "multipart/form-data; boundary=b"}
        with suppress(httpx.TransportError):  # the server may close before the client has read the answer
            problem(client.post(RECONSTRUCTIONS, content=endless(), headers=headers), 413)
        assert sum(sent) < 100_000_000
        figures = client.get("/metrics").text
        assert 'morphoflow_requests_total{method="POST",route="/v1/reconstructions",status="413"} 1.0' in figures
        assert client.get("/healthz").status_code == 200


def test_too_many_masks_are_refused(tmp_path):
    with running(app_for(tmp_path, max_masks=2)) as client:
        assert problem(client.post(RECONSTRUCTIONS, files=mask_parts(b"a", b"b", b"c")), 413)["part"] == "mask"


def test_many_small_files_are_refused_while_they_arrive(tmp_path):
    """Each part is held in memory up to a megabyte."""

    def parts():
        for number in range(200):
            head = f'--b\r\nContent-Disposition: form-data; name="mask"; filename="{number}"\r\n\r\n'
            yield head.encode() + b"x" * 100_000 + b"\r\n"
        yield b"--b--\r\n"

    with running(app_for(tmp_path, max_masks=2)) as client:
        headers = {"Content-Type": "multipart/form-data; boundary=b"}
        assert problem(client.post(RECONSTRUCTIONS, content=parts(), headers=headers), 413)["part"] == "mask"
        names = [(f"name{number}", (None, "x")) for number in range(100)]
        assert problem(client.post(RECONSTRUCTIONS, files=names), 413)["part"] == "body"


def test_an_answer_of_too_many_voxels_is_refused(tmp_path):
    with running(app_for(tmp_path, max_voxels=120_000)) as client:
        created = client.post(RECONSTRUCTIONS, files=mask_parts())
        assert created.status_code == 201
        fine = client.get(f"{created.json()['links']['segmentation']}?spacing_mm=0.25")
        assert problem(fine, 413)["part"] == "spacing_mm"
        for path in (f"{SAMPLES}/1", SAMPLES):
            assert problem(client.get(path, params={"spacing_mm": 0.25}), 413)["part"] == "spacing_mm"


def test_a_surface_of_too_many_voxels_is_refused_at_once(tmp_path):
    with running(app_for(tmp_path, max_voxels=50_000)) as client:
        asked = {"resolution_mm": "0.25"}
        archive = {"kind": (None, "reconstructions"), "resolution_mm": (None, "0.25"), "archive": ("a.zip", b"")}
        for answer in (
            client.post(RECONSTRUCTIONS, files=mask_parts(), data=asked),
            client.post(RECONSTRUCTIONS, files=mask_parts(), data=asked, headers={"Prefer": "respond-async"}),
            client.post("/v1/jobs", files=archive),
        ):
            told = problem(answer, 413)
            assert told["part"] == "resolution_mm"
            assert "resolution_mm" in told["detail"]


def test_a_mask_of_too_many_voxels_is_refused(tmp_path):
    with running(app_for(tmp_path, max_voxels=1000)) as client:
        assert problem(client.post(RECONSTRUCTIONS, files=mask_parts()), 413)["part"] == "mask[0]"


def test_a_result_larger_than_the_store_is_refused(tmp_path):
    with running(app_for(tmp_path, results_max_bytes=100)) as client:
        problem(client.post(RECONSTRUCTIONS, files=mask_parts()), 507)


def test_too_much_work_is_refused_and_accepted_again_later(tmp_path):
    model, decoder = gated_model()
    app = app_for(tmp_path, model, workers=1, max_waiting=0, retry_after_s=7)
    with running(app) as client, ThreadPoolExecutor(1) as pool:
        first = pool.submit(client.get, f"{SAMPLES}/1")
        assert decoder.entered.wait(30.0)
        refused = client.get(f"{SAMPLES}/2")
        assert problem(refused, 503)["type"].endswith("overloaded")
        assert refused.headers["retry-after"] == "7"
        assert problem(client.get("/readyz"), 503)["detail"]
        assert client.get("/healthz").status_code == 200
        assert "\nmorphoflow_work_running 1.0" in client.get("/metrics").text
        decoder.gate.set()
        assert first.result(30.0).status_code == 200
        assert client.get(f"{SAMPLES}/2").status_code == 200
        assert client.get("/readyz").status_code == 200


@pytest.mark.parametrize("path", [f"{SAMPLES}/1", f"{SAMPLES}?count=3"])
def test_a_client_that_goes_away_leaves_its_place(tmp_path, path):
    model, decoder = gated_model()
    with running(app_for(tmp_path, model, workers=1, max_waiting=0)) as client:
        with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
            connection.sendall(f"GET {path} HTTP/1.1\r\nHost: here\r\n\r\n".encode())
            assert decoder.entered.wait(30.0)
        decoder.gate.set()
        until(lambda: client.get("/readyz").status_code == 200)
        assert client.get(f"{SAMPLES}/2").status_code == 200


def test_a_client_that_leaves_a_reconstruction_ends_it_at_its_next_stage(tmp_path):
    model, decoder = gated_model()
    log = io.StringIO()
    with running(app_for(tmp_path, model, log=log, workers=1, max_waiting=0)) as client:
        request = client.build_request("POST", RECONSTRUCTIONS, files=mask_parts())
        body = request.read()
        head = f"POST {RECONSTRUCTIONS} HTTP/1.1\r\nHost: here\r\nContent-Length: {len(body)}\r\n"
        with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
            connection.sendall(f"{head}Content-Type: {request.headers['content-type']}\r\n\r\n".encode() + body)
            assert decoder.entered.wait(30.0)
        until(lambda: '"status": 499' in log.getvalue())
        decoder.gate.set()
        until(lambda: client.get("/readyz").status_code == 200)
        assert list((tmp_path / "results").iterdir()) == []


def until(condition):
    while not condition():
        time.sleep(0.005)


def test_a_key_is_asked_for_where_one_is_set(tmp_path):
    with running(app_for(tmp_path, api_keys=("first", "second"))) as client:
        refused = client.get("/v1/models")
        assert problem(refused, 401)["type"].endswith("unauthorised")
        assert refused.headers["www-authenticate"].startswith("Bearer")
        for headers in (
            {"X-API-Key": "first"},
            {"X-API-Key": "second"},
            {"Authorization": "Bearer second"},
            {"Authorization": "bearer first"},
        ):
            assert client.get("/v1/models", headers=headers).status_code == 200
        for headers in (
            {"X-API-Key": "firs"},
            {"Authorization": "first"},
            {"Authorization": "Basic first"},
            {"X-API-Key": ""},
        ):
            problem(client.get("/v1/models", headers=headers), 401)


def test_a_key_may_hold_any_letters(tmp_path):
    with running(app_for(tmp_path, api_keys=("schlüssel",))) as client:
        for sent, status in (("schlüssel", 200), ("schlussel", 401)):
            headers = {b"X-API-Key": sent.encode()}
            assert client.get("/v1/models", headers=headers).status_code == status


@pytest.mark.parametrize(
    "path", ["/healthz", "/readyz", "/docs", "/openapi.json", "/static-offline-docs/swagger-ui.css"]
)
def test_probes_and_the_description_need_no_key(tmp_path, path):
    with running(app_for(tmp_path, api_keys=("k",))) as client:
        assert client.get(path).status_code == 200


@pytest.mark.parametrize(
    "path", ["/metrics", "/redoc", "/nowhere", "/v1/reconstructions/x", "/healthz/", "//healthz/../v1/models"]
)
def test_everything_else_needs_one(tmp_path, path):
    with running(app_for(tmp_path, api_keys=("k",))) as client:
        assert client.get(path).status_code == 401


def test_a_large_body_without_a_key_is_not_read(tmp_path):
    with running(app_for(tmp_path, api_keys=("k",), max_body_bytes=10)) as client:
        problem(client.post(RECONSTRUCTIONS, files=mask_parts(b"x" * 100)), 401)


def test_samples_behind_a_key_stay_out_of_shared_caches(tmp_path):
    with running(app_for(tmp_path, api_keys=("k",)), headers={"X-API-Key": "k"}) as client:
        assert client.get(f"{SAMPLES}/1").headers["cache-control"].startswith("private")


@dataclass(frozen=True)
class FaultyDecoder(EllipsoidDecoder):
    """Fails, and says where it is."""

    def logits(self, latent, points):  # noqa: ARG002
        raise RuntimeError("at /secret/place")


def test_a_fault_is_logged_with_its_trace_and_told_without(tmp_path):
    log = io.StringIO()
    model = replace(ellipsoid_model(NAME), decoder=FaultyDecoder())
    with running(app_for(tmp_path, model, log=log)) as client:
        answer = client.get(f"{SAMPLES}/1")
        told = problem(answer, 500)
        assert "/secret" not in answer.text
        assert "Traceback" not in answer.text
        entries = [json.loads(line) for line in log.getvalue().splitlines()]
        (fault,) = [entry for entry in entries if entry["event"] == "fault"]
        assert fault["request_id"] == told["request_id"] == answer.headers["x-request-id"]
        (exception,) = fault["exception"]
        assert exception["exc_type"] == "RuntimeError"
        innermost = exception["frames"][-1]
        assert (innermost["filename"], innermost["name"]) == ("tests/integration/test_service_limits.py", "logits")
        assert "/secret" not in log.getvalue()
        assert client.get("/readyz").status_code == 200


def test_a_fault_of_an_upload_is_logged_without_its_file(tmp_path):
    log = io.StringIO()
    model = replace(ellipsoid_model(NAME), decoder=FaultyDecoder())
    with running(app_for(tmp_path, model, log=log)) as client:
        files = [("mask", (f"{SECRET}.nii", mask_parts()[0][1][1]))]
        problem(client.post(RECONSTRUCTIONS, files=files, headers={"X-Patient": SECRET}), 500)
    (fault,) = [line for line in log.getvalue().splitlines() if '"event": "fault"' in line]
    assert '"service/use_cases.py"' in fault
    assert len(fault) < 10_000
    for hidden in (SECRET, str(tmp_path), "/secret", "f_locals", "bytearray"):
        assert hidden not in log.getvalue()


def test_nothing_that_identifies_a_person_is_logged_or_told(tmp_path):
    log = io.StringIO()
    with running(app_for(tmp_path, log=log)) as client:
        for data in (b"junk", mask_parts()[0][1][1]):
            for query in ("", f"?patient={SECRET}"):
                files = [("mask", (f"{SECRET}.nii", data))]
                answer = client.post(f"{RECONSTRUCTIONS}{query}", files=files, data={"label": "1"})
                assert SECRET not in answer.text
        client.get(f"/patients/{SECRET}")
        client.get(f"/v1/models/{SECRET}")
    assert SECRET not in log.getvalue()
    assert {json.loads(line)["event"] for line in log.getvalue().splitlines()} >= {"started", "request", "stopped"}


def test_without_a_model_the_service_is_not_ready_but_alive(tmp_path):
    registry = ModelRegistry({}, [BrokenModel("half", "manifest.json is missing.")])
    with running(create_app(settings_for(tmp_path), registry=registry)) as client:
        problem(client.get("/readyz"), 503)
        assert client.get("/healthz").status_code == 200
        assert problem(client.post(RECONSTRUCTIONS, files=mask_parts()), 422)["part"] == "model"


def test_broken_models_are_named_beside_the_loaded_ones(tmp_path):
    log = io.StringIO()
    registry = ModelRegistry({NAME: ellipsoid_model(NAME)}, [BrokenModel("half", "manifest.json is missing.")])
    with running(create_app(settings_for(tmp_path), registry=registry, log=make_log("info", log))) as client:
        assert client.get("/readyz").json()["broken"] == [{"name": "half", "reason": "manifest.json is missing."}]
    assert "manifest.json is missing." in log.getvalue()


def test_results_survive_a_restart_and_expire(tmp_path):
    with running(app_for(tmp_path)) as client:
        links = client.post(RECONSTRUCTIONS, files=mask_parts()).json()["links"]
        meshes = [client.get(links["mesh"]).content]
    with running(app_for(tmp_path)) as client:
        meshes.append(client.get(links["mesh"]).content)
        assert client.get(links["segmentation"]).status_code == 200
    assert meshes[0] == meshes[1]
    with running(app_for(tmp_path, result_lifetime_s=0.001, sweep_interval_s=0.01)) as client:
        made = client.post(RECONSTRUCTIONS, files=mask_parts()).json()
        until(lambda: not (tmp_path / "results" / made["id"]).exists())
        problem(client.get(made["links"]["self"]), 404)
        assert client.get(links["self"]).status_code == 200


def test_a_result_of_another_version_of_the_model_keeps_its_mesh(tmp_path):
    with running(app_for(tmp_path)) as client:
        links = client.post(RECONSTRUCTIONS, files=mask_parts()).json()["links"]
    with running(app_for(tmp_path, ellipsoid_model(NAME, (10.0, 10.0, 10.0)))) as client:
        assert client.get(links["mesh"]).status_code == 200
        assert client.get(links["surface_sd"]).status_code == 200
        assert problem(client.get(links["segmentation"]), 404)["type"].endswith("not-computed")


def test_parallel_requests_give_what_single_ones_give(tmp_path):
    with running(app_for(tmp_path, workers=2, max_waiting=16)) as client, ThreadPoolExecutor(6) as pool:
        single = [client.get(f"{SAMPLES}/{seed}").content for seed in range(6)]
        together = list(pool.map(lambda seed: client.get(f"{SAMPLES}/{seed}").content, range(6)))
    assert single == together
    assert len(set(single)) == 6
