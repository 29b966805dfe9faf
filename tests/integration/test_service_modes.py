"""Modes over HTTP: ranked, cacheable, surfaces with what moves them at each vertex."""

import io
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from service.app import create_app
from service.model_registry import ModelRegistry, pinned_name
from service.ports import MeshFormat
from service.routes.responses import MESH_MEDIA_TYPES
from tests.analytic_model import MEAN_AXES, SPREAD, ellipsoid_model
from tests.service_parts import NAME, app_for, running, settings_for

PLACE = f"/v1/models/{NAME}"


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running(app_for(tmp_path_factory.mktemp("modes"))) as client:
        yield client


def mesh_of(answer, format="ply"):
    assert answer.status_code == 200, answer.text
    return trimesh.load(io.BytesIO(answer.content), file_type=format, process=False)


def volume(axes):
    return 4.0 / 3.0 * np.pi * np.prod(axes)


def test_modes_are_ranked_and_lead_to_their_surfaces(client):
    listed = client.get(f"{PLACE}/modes").json()
    assert listed["model"]["name"] == NAME
    assert [mode["rank"] for mode in listed["modes"]] == [1, 2, 3]
    assert [mode["dimension"] for mode in listed["modes"]] == [0, 1, 2]
    assert listed["modes"][-1]["cumulative_variance"] == pytest.approx(1.0)
    assert listed["active_dimensions"] == {"percent_95": 3, "percent_97": 3, "percent_99": 3}
    assert client.get(listed["modes"][1]["link"]).status_code == 200


@pytest.mark.parametrize("sd", [-2.0, 0.0, 1.0])
def test_the_surface_along_a_mode_is_the_code_at_so_many_deviations(client, sd):
    body = mesh_of(client.get(f"{PLACE}/modes/1", params={"sd": sd}))
    axes = np.array(MEAN_AXES) * np.exp([SPREAD * sd, 0.0, 0.0])
    assert body.is_watertight
    assert body.volume == pytest.approx(volume(axes), rel=0.01)
    assert body.extents / 2 == pytest.approx(axes, abs=0.05)


def test_vertices_carry_what_one_more_deviation_moves(client):
    answer = client.get(f"{PLACE}/modes/1", params={"sd": 0})
    (element,) = [found for name, found in mesh_of(answer).metadata["_ply_raw"].items() if name == "vertex"]
    moves, places = element["data"]["displacement_mm_per_sd"], element["data"]["x"]
    assert moves[np.argmax(places)] == pytest.approx(SPREAD * MEAN_AXES[0], rel=0.05)
    np.testing.assert_allclose(element["data"]["distance_to_mean_mm"], 0.0, atol=1e-6)


def test_several_modes_at_once(client):
    for query in ([("mode", "1:1"), ("mode", "3:-2")], [("mode", "1:1, 3:-2")]):
        body = mesh_of(client.get(f"{PLACE}/shape", params=query))
        assert body.extents / 2 == pytest.approx(np.array(MEAN_AXES) * np.exp([SPREAD, 0.0, -2 * SPREAD]), abs=0.05)


def test_no_mode_is_the_mean_and_one_mode_is_its_own_route(client):
    mean = client.get(f"{PLACE}/shape", params={"format": "stl"})
    assert mesh_of(mean, "stl").extents / 2 == pytest.approx(MEAN_AXES, abs=0.05)
    single, along = client.get(f"{PLACE}/shape?mode=2:1.5"), client.get(f"{PLACE}/modes/2?sd=1.5")
    assert single.content == along.content
    assert single.headers["etag"] == along.headers["etag"]


@pytest.mark.parametrize("format", list(MeshFormat))
def test_every_mesh_format(client, format):
    answer = client.get(f"{PLACE}/modes/1", params={"format": format.value, "spacing_mm": 2})
    assert answer.status_code == 200
    assert answer.headers["content-type"] == MESH_MEDIA_TYPES[format]
    assert f"{NAME}-shape.{format.value}" in answer.headers["content-disposition"]


@pytest.mark.parametrize("path", ["modes", "modes/2?sd=-1", "shape?mode=1:1&mode=2:2"])
def test_who_has_it_gets_no_second_one(client, path):
    first = client.get(f"{PLACE}/{path}")
    tag = first.headers["etag"]
    assert not tag.startswith("W/")
    assert first.headers["cache-control"] == "public, no-cache"
    again = client.get(f"{PLACE}/{path}", headers={"If-None-Match": tag})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", tag)
    assert client.get(f"{PLACE}/{path}").content == first.content


@pytest.mark.parametrize("path", ["modes", "modes/2?sd=-1", "shape?mode=1:1&mode=2:2"])
def test_only_an_address_with_a_version_is_the_same_for_ever(client, path):
    version = client.get(f"/v1/models/{NAME}").json()["version"]
    newest, pinned = client.get(f"{PLACE}/{path}"), client.get(f"{PLACE}@{version}/{path}")
    assert pinned.headers["cache-control"] == "public, max-age=31536000, immutable"
    assert (pinned.headers["etag"], pinned.content) == (newest.headers["etag"], newest.content)
    again = client.get(f"{PLACE}@{version}/{path}", headers={"If-None-Match": newest.headers["etag"]})
    assert (again.status_code, again.headers["cache-control"]) == (304, pinned.headers["cache-control"])


def test_a_newer_model_takes_over_where_no_version_is_named(tmp_path):
    older, newer = ellipsoid_model(NAME), ellipsoid_model(NAME, (10.0, 10.0, 10.0))
    newer = replace(newer, manifest=replace(newer.manifest, version="2.0.0"))
    there = [older]
    registry = ModelRegistry(
        {pinned_name(older): older}, (), lambda: ModelRegistry({pinned_name(model): model for model in there})
    )
    with running(create_app(settings_for(tmp_path), registry=registry)) as client:
        before = client.get(f"{PLACE}/shape")
        there.append(newer)
        registry.refresh()
        held = {"If-None-Match": before.headers["etag"]}
        assert client.get(f"{PLACE}/shape", headers=held).status_code == 200
        assert client.get(f"{PLACE}@1.0.0/shape", headers=held).status_code == 304


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("modes", 304),
        ("modes/1", 304),
        ("modes/99", 404),
        ("shape?mode=99:1", 404),
        ("samples/1", 304),
        ("samples/1?spacing_mm=0.25", 413),
    ],
)
def test_any_copy_is_confirmed_of_what_there_is(tmp_path, path, status):
    with running(app_for(tmp_path, max_voxels=200_000)) as client:
        answer = client.get(f"{PLACE}/{path}", headers={"If-None-Match": "*"})
        assert answer.status_code == status
        assert status != 304 or answer.headers["etag"] == client.get(f"{PLACE}/{path}").headers["etag"]


def test_whatever_changes_the_surface_changes_its_etag(client):
    paths = ["modes", "modes/1", "modes/1?sd=1", "modes/2?sd=1", "modes/1?sd=1&spacing_mm=2", "modes/1?sd=1&format=stl"]
    paths += ["shape", "shape?mode=1:1,2:1", "shape?mode=1:1,2:1.5"]
    tags = {client.get(f"{PLACE}/{path}").headers["etag"] for path in paths}
    assert len(tags) == len(paths)


def test_the_order_of_modes_does_not_matter(client):
    first, second = (client.get(f"{PLACE}/shape?mode={order}") for order in ("1:1,2:-1", "2:-1,1:1"))
    assert first.content == second.content
    assert first.headers["etag"] == second.headers["etag"]


@pytest.mark.parametrize(
    ("path", "status", "kind"),
    [
        ("modes/4", 404, "unknown-mode"),
        ("shape?mode=4:1", 404, "unknown-mode"),
        ("modes/0", 422, "invalid-parameter"),
        ("modes/first", 422, "invalid-parameter"),
        ("modes/1?sd=5.5", 422, "invalid-parameter"),
        ("modes/1?sd=nan", 422, "invalid-parameter"),
        ("modes/1?format=nifti", 422, "invalid-parameter"),
        ("modes/1?spacing_mm=0.1", 422, "invalid-parameter"),
        ("modes/1?std=1", 422, "invalid-parameter"),
        ("shape?mode=1", 422, "invalid-parameter"),
        ("shape?mode=1:", 422, "invalid-parameter"),
        ("shape?mode=:1", 422, "invalid-parameter"),
        ("shape?mode=1:nan", 422, "invalid-parameter"),
        ("shape?mode=1:6", 422, "invalid-parameter"),
        ("shape?mode=1:1&mode=1:2", 422, "invalid-parameter"),
        ("shape?mode=", 422, "invalid-parameter"),
    ],
)
def test_what_cannot_be_asked_is_named(client, path, status, kind):
    answer = client.get(f"{PLACE}/{path}")
    assert answer.status_code == status
    assert answer.json()["type"] == f"urn:morphoflow:problem:{kind}"


def test_an_unknown_model_is_told(client):
    for path in ("modes", "modes/1", "shape"):
        told = client.get(f"/v1/models/nobody/{path}").json()
        assert (told["type"], told["part"]) == ("urn:morphoflow:problem:unknown-model", "model")


@pytest.mark.parametrize(("path", "part"), [("modes/4", "rank"), ("shape?mode=4:1", "mode")])
def test_a_mode_that_is_not_there_is_named_as_it_was_asked_for(client, path, part):
    assert client.get(f"{PLACE}/{path}").json()["part"] == part
