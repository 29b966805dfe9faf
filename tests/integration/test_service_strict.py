"""Slips that are refused by name: parts and parameters that nobody knows, that are sent twice, bodies cut off."""

import pytest

from tests.service_parts import NAME, app_for, mask_bytes, mask_parts, problem, running

RECONSTRUCTIONS, PLANES, JOBS = "/v1/reconstructions", "/v1/planes", "/v1/jobs"


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running(app_for(tmp_path_factory.mktemp("strict"))) as client:
        yield client


@pytest.fixture(scope="module")
def place(client):
    return client.post(RECONSTRUCTIONS, files=mask_parts()).json()["links"]["self"]


def part(name, data, file=""):
    kind = f'; filename="{file}"\r\nContent-Type: application/octet-stream' if file else ""
    return f'--B\r\nContent-Disposition: form-data; name="{name}"{kind}\r\n\r\n'.encode() + data + b"\r\n"


def send(client, path, body, boundary="B"):
    return client.post(path, content=body, headers={"Content-Type": f"multipart/form-data; boundary={boundary}"})


MASK = part("mask", mask_bytes(), "m.nii")
FORM = MASK + part("uncertainty", b"none") + part("seed", b"5")


def test_a_whole_body_counts_whatever_comes_after_it(client):
    for end in (b"--B--", b"--B--\r\n", b"--B--\r\nepilogue --B\r\n"):
        answer = send(client, RECONSTRUCTIONS, FORM + end)
        assert (answer.status_code, answer.json().get("seed")) == (201, 5)


@pytest.mark.parametrize(
    "body",
    [
        FORM[: -len("5\r\n")] + b"5",
        FORM,
        FORM + b"--B",
        FORM + b"--B-",
        FORM + b"--B\r\n",
        (MASK + MASK)[:-500],
        FORM + b"--A--\r\n",
        b"",
        b"--B-",
    ],
)
def test_a_body_that_is_cut_off_is_no_other_request(client, body):
    told = problem(send(client, RECONSTRUCTIONS, body), 400)
    assert told["type"].endswith("malformed-request")
    assert "cut off" in told["detail"]


@pytest.mark.parametrize("path", [RECONSTRUCTIONS, PLANES, JOBS])
def test_every_form_must_be_whole(client, path):
    assert "cut off" in problem(send(client, path, MASK), 400)["detail"]


def test_a_body_is_whole_however_it_is_cut_into_pieces(client):
    whole = FORM + b"--B--\r\n"

    def pieces(body):
        yield body[:-9]
        for byte in body[-9:]:
            yield bytes([byte])

    assert send(client, RECONSTRUCTIONS, pieces(whole)).status_code == 201
    problem(send(client, RECONSTRUCTIONS, pieces(whole[:-3])), 400)


@pytest.mark.parametrize("path", [RECONSTRUCTIONS, PLANES])
def test_a_part_that_nobody_knows_is_named_before_those_that_are_missing(client, path):
    told = problem(client.post(path, files=[("msk", ("a.nii", mask_bytes()))]), 422)
    assert told["part"] == "msk"
    assert "msk" in told["detail"]
    assert "mask, " in told["detail"]


@pytest.mark.parametrize(("name", "value"), [("seed", "1"), ("resolution_mm", "1"), ("annotated", "auto")])
def test_a_part_that_is_no_list_is_sent_once(client, name, value):
    twice = [*mask_parts(), (name, (None, value)), (name, (None, value))]
    told = problem(client.post(RECONSTRUCTIONS, files=twice), 422)
    assert told["part"] == name
    assert f"{name} is sent 2 times" in told["detail"]


def test_lists_are_sent_as_often_as_one_likes(client):
    both = [*mask_parts(), ("label", (None, "1")), ("label", (None, "2")), ("uncertainty", (None, "none"))]
    answer = client.post(RECONSTRUCTIONS, files=both)
    assert answer.status_code == 201
    assert any("mask[0] does not hold label 2" in warning for warning in answer.json()["warnings"])
    assert client.get(f"/v1/models/{NAME}/shape?mode=1:1&mode=2:1").status_code == 200


def test_a_job_takes_each_part_once_and_none_that_it_does_not_know(client):
    twice = [("kind", (None, "samples")), ("count", (None, "1")), ("count", (None, "2"))]
    assert problem(client.post(JOBS, files=twice), 422)["part"] == "count"
    assert problem(client.post(JOBS, files=[*twice[:2], ("cuont", (None, "2"))]), 422)["part"] == "cuont"


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("POST", RECONSTRUCTIONS),
        ("POST", PLANES),
        ("POST", JOBS),
        ("GET", "/v1/models"),
        ("GET", f"/v1/models/{NAME}"),
        ("GET", f"/v1/models/{NAME}/modes"),
        ("GET", f"/v1/models/{NAME}/modes/1"),
        ("GET", f"/v1/models/{NAME}/samples"),
        ("GET", f"{RECONSTRUCTIONS}/x"),
        ("DELETE", f"{RECONSTRUCTIONS}/x"),
        ("GET", f"{RECONSTRUCTIONS}/x/features"),
        ("GET", f"{RECONSTRUCTIONS}/x/mesh"),
        ("GET", f"{JOBS}/x"),
        ("GET", f"{JOBS}/x/result"),
    ],
)
def test_a_parameter_that_nobody_knows_is_refused_everywhere(client, method, path):
    told = problem(client.request(method, path, params={"sead": 5}), 422)
    assert (told["part"], "sead" in told["detail"]) == ("sead", True)


@pytest.mark.parametrize(
    ("path", "name"), [("samples/1", "spacing_mm"), ("samples", "seed"), ("modes/1", "sd"), ("shape", "format")]
)
def test_a_parameter_that_is_no_list_is_sent_once(client, path, name):
    told = problem(client.get(f"/v1/models/{NAME}/{path}?{name}=2&{name}=3"), 422)
    assert told["part"] == name


def test_names_are_those_of_the_interface(client, place):
    told = problem(client.get(f"{place}/interpolation", params={"other": "x"}), 422)
    assert told["part"] == "other"
    names = told["detail"].removesuffix(".").split(": ")[1].split(", ")
    assert names == ["with", "at", "steps", "format", "spacing_mm"]
    assert problem(client.get(f"{place}/interpolation", params={"other": "x", "with": "x"}), 422)["part"] == "other"


@pytest.mark.parametrize("name", ["a" * 5000, "a\nb", "\u200b", ""])
def test_odd_names_are_not_repeated_in_a_sentence(client, name):
    told = problem(client.get("/v1/models", params={name: "1"}), 422)
    assert told["detail"] == "There is no such parameter; accepted are: none."


@pytest.mark.parametrize(("path", "name"), [("interpolation", "with"), ("comparison", "other")])
def test_a_result_that_a_parameter_names_and_that_is_not_there_is_named(client, place, path, name):
    told = problem(client.get(f"{place}/{path}", params={name: "nobody"}), 404)
    assert (told["type"], told["part"]) == ("urn:morphoflow:problem:unknown-result", name)
    assert f"parameter {name}" in told["detail"]
    whole = place.rsplit("/", 1)[1]
    assert problem(client.get(f"{RECONSTRUCTIONS}/nobody/{path}", params={name: whole}), 404)["part"] == "id"


def test_a_spacing_is_refused_where_there_are_no_voxels(client, place):
    told = problem(client.get(f"{place}/uncertainty", params={"kind": "surface_sd", "spacing_mm": 1}), 422)
    assert told["part"] == "spacing_mm"
    assert client.get(f"{place}/uncertainty", params={"kind": "surface_sd"}).status_code == 200


def test_bodies_of_other_kinds_are_refused_before_they_are_read(client):
    for headers in ({}, {"Content-Type": "application/x-www-form-urlencoded"}, {"Content-Type": "multipart/mixed"}):
        problem(client.post(RECONSTRUCTIONS, content=b"seed=1", headers=headers), 415)
    told = problem(client.post(RECONSTRUCTIONS, content=b"x", headers={"Content-Type": "multipart/form-data"}), 400)
    assert "boundary" in told["detail"]
