"""Features and interpolation over HTTP; batches of pairs, counted rejections, batches by several workers."""

import io
import json
import zipfile

import numpy as np
import pytest
import trimesh

from tests.analytic_model import EllipsoidDecoder
from tests.service_parts import NAME, app_for, mask_bytes, mask_parts, running

RECONSTRUCTIONS = "/v1/reconstructions"
SAMPLES = f"/v1/models/{NAME}/samples"


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running(app_for(tmp_path_factory.mktemp("latent"), workers=2, max_samples=20)) as client:
        yield client


@pytest.fixture(scope="module")
def pair(client):
    """Identifiers of a slim and a stout ellipsoid."""
    masks = [mask_bytes(axes) for axes in ((13.5, 8.0, 6.5), (11.0, 10.0, 8.0))]
    answers = [client.post(RECONSTRUCTIONS, files=mask_parts(mask)).json() for mask in masks]
    return [answer["id"] for answer in answers]


def volume(answer):
    assert answer.status_code == 200, answer.text
    return trimesh.load(io.BytesIO(answer.content), file_type="ply", process=False).volume


def features(client, identifier):
    answer = client.get(f"{RECONSTRUCTIONS}/{identifier}/features")
    assert answer.status_code == 200
    return answer.json()


def test_features_tell_the_code_and_its_place_in_the_population(client, pair):
    slim, stout = (features(client, identifier) for identifier in pair)
    assert {len(slim[name]) for name in ("latent", "base", "population_mean", "population_sd", "active")} == {3}
    assert slim["latent"][0] > stout["latent"][0]
    assert slim["latent"][1] < stout["latent"][1]
    assert all(0 < value < 1 for value in slim["posterior_sd"])
    np.testing.assert_allclose(slim["base"], slim["latent"])
    assert 0 <= slim["typicality_percentile"] <= 100


def test_half_way_is_between_and_the_ends_are_the_shapes(client, pair):
    place = f"{RECONSTRUCTIONS}/{pair[0]}/interpolation"
    codes = [np.array(features(client, identifier)["latent"]) for identifier in pair]
    for at in (0.0, 0.5, 1.0):
        axes = EllipsoidDecoder().axes(((1 - at) * codes[0] + at * codes[1])[None])[0]
        found = volume(client.get(place, params={"with": pair[1], "at": at}))
        assert found == pytest.approx(4 / 3 * np.pi * np.prod(axes), rel=0.04)


def test_steps_are_a_zip_of_surfaces(client, pair):
    place = f"{RECONSTRUCTIONS}/{pair[0]}/interpolation"
    answer = client.get(place, params={"with": pair[1], "steps": 4, "spacing_mm": 2})
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    *names, last = archive.namelist()
    assert last == "manifest.json"
    shapes = json.loads(archive.read(last))["shapes"]
    assert [shape["file"] for shape in shapes] == names
    assert [shape["at"] for shape in shapes] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    single = client.get(place, params={"with": pair[1], "at": shapes[1]["at"], "spacing_mm": 2})
    assert archive.read(names[1]) == single.content


@pytest.mark.parametrize(
    ("query", "status", "kind"),
    [
        ({}, 422, "invalid-parameter"),
        ({"with": "nobody"}, 404, "unknown-result"),
        ({"at": 1.5}, 422, "invalid-parameter"),
        ({"at": 0.5, "steps": 3}, 422, "invalid-parameter"),
        ({"steps": 1}, 422, "invalid-parameter"),
        ({"steps": 65}, 422, "invalid-parameter"),
        ({"spacing_mm": 0.1}, 422, "invalid-parameter"),
    ],
)
def test_what_cannot_be_asked_is_named(client, pair, query, status, kind):
    whole = {"with": pair[1], **query} if query else {}
    answer = client.get(f"{RECONSTRUCTIONS}/{pair[0]}/interpolation", params=whole)
    assert answer.status_code == status
    assert answer.json()["type"] == f"urn:morphoflow:problem:{kind}"


def test_a_batch_by_several_workers_is_in_order_and_the_same_again(client):
    query = {"count": 9, "seed": 40, "format": "stl", "spacing_mm": 2}
    first, second = (client.get(SAMPLES, params=query) for _ in range(2))
    names = [f"{NAME}-{seed}.stl" for seed in range(40, 49)]
    for answer in (first, second):
        archive = zipfile.ZipFile(io.BytesIO(answer.content))
        assert archive.namelist() == [*names, "manifest.json"]
    contents = [zipfile.ZipFile(io.BytesIO(answer.content)) for answer in (first, second)]
    assert all(contents[0].read(name) == contents[1].read(name) for name in (*names, "manifest.json"))


def test_pairs_hold_a_label_map_and_a_drawing_of_it(client):
    answer = client.get(SAMPLES, params={"count": 2, "seed": 1, "format": "pairs"})
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    manifest = json.loads(archive.read("manifest.json"))
    for item in manifest["samples"]:
        pair = np.load(io.BytesIO(archive.read(item["file"])))
        known = pair["sparse"] != 255
        np.testing.assert_array_equal(pair["sparse"][known], pair["dense"][known])
        assert pair["planes"].tolist() == [[plane["axis"], plane["index"]] for plane in item["planes"]]
        assert known.sum() < 0.5 * known.size
        size_ml = pair["dense"].sum() * abs(np.linalg.det(pair["affine"])) / 1000
        assert size_ml == pytest.approx(item["volume_ml"], rel=0.05)


def test_the_manifest_counts_what_was_rejected(client):
    """At twice the spread some draws leave the range of volumes."""
    query = {"count": 12, "temperature": 2, "format": "stl", "spacing_mm": 3}
    kept, all_ = (
        json.loads(zipfile.ZipFile(io.BytesIO(client.get(SAMPLES, params=q).content)).read("manifest.json"))
        for q in (query, {**query, "reject": False})
    )
    assert kept["rejected"]["volume"] == sum(item["rejected"].get("volume", 0) for item in kept["samples"]) > 0
    low, high = kept["volume_range_ml"]
    assert all(low <= item["volume_ml"] <= high for item in kept["samples"] if item["plausible"])
    assert (kept["reject"], all_["reject"]) == (True, False)
    assert all_["rejected"] == {}
    assert {item["plausible"] for item in all_["samples"]} == {None}
    assert any(not low <= item["volume_ml"] <= high for item in all_["samples"])


def test_too_large_a_batch_is_told_of_jobs(client):
    answer = client.get(SAMPLES, params={"count": 10_000})
    assert answer.status_code == 413
    assert "job of kind samples" in answer.json()["detail"]


def test_identifiers_may_be_written_in_capitals(client, pair):
    shouted = [identifier.upper() for identifier in pair]
    answer = client.get(f"{RECONSTRUCTIONS}/{shouted[0]}/interpolation", params={"with": shouted[1]})
    told = client.get(f"{RECONSTRUCTIONS}/{pair[0]}/interpolation", params={"with": pair[1]})
    assert answer.status_code == 200
    assert answer.content == told.content


def test_an_ensembles_draws_are_counted_before_they_come_again(client):
    made = client.post(RECONSTRUCTIONS, files=mask_parts(), data={"uncertainty": "ensemble"}).json()
    batch = client.get(made["links"]["posterior"], params={"count": 20, "seed": 20, "format": "ply", "spacing_mm": 2.0})
    with zipfile.ZipFile(io.BytesIO(batch.content)) as archive:
        manifest = json.loads(archive.read("manifest.json"))
    draws = [tuple(sample["latent"]) for sample in manifest["samples"]]
    assert manifest["members"] == 25
    assert len(set(draws[:5])) == 5
    assert len(set(draws[5:])) == 15
    assert set(draws[5:]) & set(draws[:5])
