"""Headers: repeated lines, methods that are allowed, answers without a body, and copies that a client holds."""

from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.service_parts import NAME, app_for, gated_model, mask_parts, problem, running

RECONSTRUCTIONS = "/v1/reconstructions"
SAMPLE = f"/v1/models/{NAME}/samples/1"


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running(app_for(tmp_path_factory.mktemp("headers"))) as client:
        yield client


@pytest.fixture(scope="module")
def links(client):
    return client.post(RECONSTRUCTIONS, files=mask_parts(), data={"uncertainty": "none"}).json()["links"]


def test_lines_of_a_header_count_together(client):
    wanted = [("Accept", "application/xml"), ("Accept", "model/stl")]
    made = client.post(RECONSTRUCTIONS, files=mask_parts(), data={"uncertainty": "none"}, headers=wanted)
    assert (made.status_code, made.headers["content-type"]) == (200, "model/stl")
    held = client.get(SAMPLE).headers["etag"]
    assert client.get(SAMPLE, headers=[("If-None-Match", '"other"'), ("If-None-Match", held)]).status_code == 304
    wishes = [("Prefer", "wait=1"), ("Prefer", "respond-async")]
    assert client.post(RECONSTRUCTIONS, files=mask_parts(), headers=wishes).status_code == 202


@pytest.mark.parametrize(
    ("accept", "media"),
    [
        (None, "application/x-ply"),
        ("*/*", "application/x-ply"),
        ("text/html, */*;q=0.8", "application/x-ply"),
        ("model/stl", "model/stl"),
        ("model/obj;q=0.5, application/x-mz3", "application/x-mz3"),
    ],
)
def test_a_mesh_without_a_format_is_what_accept_likes_best(client, links, accept, media):
    with client.stream("GET", links["mesh"], headers={} if accept is None else {"Accept": accept}) as answer:
        assert (answer.status_code, answer.headers["content-type"]) == (200, media)
        assert answer.headers["vary"] == "Accept"


def test_a_mesh_that_nobody_can_make_is_refused_unless_a_format_is_named(client, links):
    headers = {"Accept": "text/html"}
    assert problem(client.get(links["mesh"], headers=headers), 406)["type"].endswith("not-acceptable")
    named = client.get(links["mesh"], params={"format": "obj"}, headers=headers)
    assert (named.status_code, named.headers["content-type"]) == (200, "model/obj")


def test_a_preference_is_applied_where_there_was_one(client):
    form = {"kind": (None, "samples"), "count": (None, "1")}
    assert "preference-applied" not in client.post("/v1/jobs", files=form).headers
    asked = client.post("/v1/jobs", files=form, headers={"Prefer": "respond-async"})
    assert asked.headers["preference-applied"] == "respond-async"


def test_all_methods_of_a_path_are_allowed(client, links):
    for path, allowed in (
        (links["self"], "DELETE, GET, HEAD"),
        (links["mesh"], "GET, HEAD"),
        (RECONSTRUCTIONS, "POST"),
        ("/v1/models", "GET, HEAD"),
        ("/v1/jobs/x", "DELETE, GET, HEAD"),
        ("/docs", "GET, HEAD"),
    ):
        refused = client.patch(path)
        assert problem(refused, 405)["type"].endswith("method-not-allowed")
        assert refused.headers["allow"] == allowed
    assert client.head(RECONSTRUCTIONS).headers["allow"] == "POST"


@pytest.mark.parametrize(
    "path", ["/healthz", "/", "/docs", "/openapi.json", "/metrics", "/v1/models", SAMPLE, f"/v1/models/{NAME}/modes"]
)
def test_head_has_the_headers_of_get_and_no_body(client, path):
    whole, head = client.get(path), client.head(path)
    assert (head.status_code, head.content) == (whole.status_code, b"")
    own = {"x-request-id", "date", *(["content-length"] if path == "/metrics" else [])}
    assert {name: head.headers[name] for name in set(head.headers) - own} == {
        name: whole.headers[name] for name in set(whole.headers) - own
    }
    assert client.head(path, headers={"If-None-Match": head.headers.get("etag", "-")}).status_code in (200, 304)


def test_head_of_results_problems_and_streams(client, links):
    assert client.head(links["mesh"]).headers["content-length"] == str(len(client.get(links["mesh"]).content))
    assert client.head(f"{RECONSTRUCTIONS}/x").status_code == 404
    batch = f"/v1/models/{NAME}/samples"
    assert client.head(batch, params={"count": 200}).headers["content-type"] == "application/zip"
    assert client.head(batch, params={"count": 10**6}).status_code == 413
    figures = client.get("/metrics").text
    counted = 'morphoflow_requests_total{method="HEAD",route="/v1/models/{model}/samples",status="200"} 1.0'
    assert counted in figures
    assert 'status="500"' not in figures
    assert client.get("/readyz").status_code == 200


def test_a_copy_that_is_held_is_confirmed_while_too_much_work_waits(tmp_path):
    model, decoder = gated_model()
    paths = [SAMPLE, *(f"/v1/models/{NAME}/{path}" for path in ("modes", "modes/1", "shape?mode=1:2"))]
    with running(app_for(tmp_path, model, workers=1, max_waiting=0)) as client, ThreadPoolExecutor(1) as pool:
        decoder.gate.set()
        held = {path: client.get(path).headers["etag"] for path in paths}
        decoder.gate.clear()
        decoder.entered.clear()
        busy = pool.submit(client.get, f"/v1/models/{NAME}/samples/2")
        assert decoder.entered.wait(30.0)
        for path, tag in held.items():
            assert client.get(path).status_code == 503
            assert client.get(path, headers={"If-None-Match": tag}).status_code == 304
        decoder.gate.set()
        assert busy.result(30.0).status_code == 200


@pytest.mark.parametrize(
    "path",
    [
        "/%00",
        f"{RECONSTRUCTIONS}/%00",
        f"{RECONSTRUCTIONS}/%00/mesh",
        f"{RECONSTRUCTIONS}/%00/segmentation",
        "/v1/models/%00",
        "/v1/models/a%00b/samples/1",
        "/v1/models/%00/modes",
        "/page/%00",
        "/static-offline-docs/%00",
        "/dicom-web/studies%00",
    ],
)
def test_nothing_stands_at_a_path_with_a_null_byte(client, path):
    assert client.get(path).status_code == 404


@pytest.mark.parametrize("path", [f"{RECONSTRUCTIONS}/%00", "/v1/jobs/%00"])
def test_nothing_of_a_name_with_a_null_byte_is_deleted(client, path):
    problem(client.delete(path), 404)
