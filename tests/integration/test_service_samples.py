"""Samples over HTTP: a real server, the analytic model with its exact answers."""

import io
import json
import zipfile

import numpy as np
import pytest

from service.ports import SampleFormat
from tests.analytic_model import EllipsoidDecoder
from tests.service_parts import NAME, app_for, image, problem, running

SAMPLES = f"/v1/models/{NAME}/samples"


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running(app_for(tmp_path_factory.mktemp("samples"))) as client:
        yield client


def test_a_sample_is_a_pure_function_of_its_address(client):
    first, second = (client.get(f"{SAMPLES}/7", params={"format": "ply"}) for _ in range(2))
    assert first.content == second.content
    assert first.headers["etag"] == second.headers["etag"]
    assert "immutable" in first.headers["cache-control"]
    assert not first.headers["etag"].startswith("W/")


def test_who_has_a_sample_gets_no_second_one(client):
    etag = client.get(f"{SAMPLES}/7").headers["etag"]
    again = client.get(f"{SAMPLES}/7", headers={"If-None-Match": etag})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", etag)


def test_whatever_changes_a_sample_changes_its_etag(client):
    queries = [{}, {"format": "ply"}, {"temperature": 0.5}, {"spacing_mm": 2.0}]
    tags = {client.get(f"{SAMPLES}/{seed}", params=query).headers["etag"] for query in queries for seed in (7, 8)}
    assert len(tags) == 2 * len(queries)


@pytest.mark.parametrize("format", list(SampleFormat))
def test_item_i_of_a_batch_is_the_sample_of_seed_plus_i(client, format):
    query = {"format": format.value, "spacing_mm": 1.5}
    answer = client.get(SAMPLES, params={**query, "count": 2, "seed": 11})
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    assert archive.testzip() is None
    *names, last = archive.namelist()
    assert last == "manifest.json"
    singles = [client.get(f"{SAMPLES}/{seed}", params=query).content for seed in (11, 12)]
    assert [archive.read(name) for name in names] == singles


def test_the_manifest_tells_each_shapes_numbers(client):
    answer = client.get(SAMPLES, params={"count": 3, "seed": 4, "format": "npz", "spacing_mm": 0.75})
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    manifest = json.loads(archive.read("manifest.json"))
    assert [item["seed"] for item in manifest["samples"]] == [4, 5, 6]
    for item in manifest["samples"]:
        latent = np.array(item["latent"])
        assert item["log_density_nats"] == pytest.approx(-0.5 * latent @ latent - 1.5 * np.log(2 * np.pi), rel=1e-5)
        axes = EllipsoidDecoder().axes(latent[None])[0]
        assert item["volume_ml"] == pytest.approx(4 / 3 * np.pi * np.prod(axes) / 1000, rel=0.03)
        assert item["nearest_training_distance"] >= 0
        np.testing.assert_array_equal(np.load(io.BytesIO(archive.read(item["file"])))["latent"], latent)


def test_the_label_map_of_a_sample_has_its_volume(client):
    labels = image(client.get(f"{SAMPLES}/3", params={"format": "nifti", "spacing_mm": 0.75}))
    latent = np.load(io.BytesIO(client.get(f"{SAMPLES}/3", params={"format": "npz"}).content))["latent"]
    exact_ml = 4 / 3 * np.pi * np.prod(EllipsoidDecoder().axes(latent[None])[0]) / 1000
    assert np.count_nonzero(np.asarray(labels.dataobj)) * 0.75**3 / 1000 == pytest.approx(exact_ml, rel=0.03)


@pytest.mark.parametrize(
    ("path", "query", "status"),
    [
        ("", {"count": 0}, 422),
        ("", {"count": 257}, 413),
        ("", {"temperature": 0}, 422),
        ("", {"sd": 1}, 422),
        ("/1", {"temperature": 2.5}, 422),
        ("/1", {"spacing_mm": 0.1}, 422),
        ("/1", {"format": "exe"}, 422),
        ("/-1", {}, 422),
        ("/x", {}, 422),
        (f"/{2**53}", {}, 422),
        ("", {"seed": 2**53 - 1, "count": 2}, 422),
    ],
)
def test_samples_out_of_range_are_refused(client, path, query, status):
    problem(client.get(f"{SAMPLES}{path}", params=query), status)
