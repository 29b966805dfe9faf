"""The whole way over HTTP: a real server, real files, the analytic model with its exact answers."""

import io
import json
import zipfile

import nibabel as nib
import numpy as np
import pytest
import trimesh

from model.inference.decimation import hausdorff_mm
from model.inference.mesh import mesh_of
from service.ports import MeshFormat
from service.routes.responses import DIRECT_FORMATS, MESH_MEDIA_TYPES
from tests.analytic_model import MEAN_AXES
from tests.analytic_shapes import Ellipsoid
from tests.service_parts import (
    NAME,
    app_for,
    image,
    mask_bytes,
    mask_parts,
    nifti_of,
    problem,
    running,
    sparse_ellipsoid,
)

AXES = (13.0, 9.5, 7.5)
RECONSTRUCTIONS = "/v1/reconstructions"
SAMPLES = f"/v1/models/{NAME}/samples"


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running(app_for(tmp_path_factory.mktemp("service"))) as client:
        yield client


@pytest.fixture(scope="module")
def created(client):
    return client.post(RECONSTRUCTIONS, files=mask_parts(mask_bytes(AXES)), data={"seed": "5"})


@pytest.fixture(scope="module")
def summary(created):
    assert created.status_code == 201
    return created.json()


def truth():
    drawn, grid = sparse_ellipsoid(AXES)
    centre = grid.to_world((np.array([drawn.shape]) - 1) / 2)[0]
    return Ellipsoid(AXES, centre), grid


def test_the_answer_says_where_the_result_is(client, created, summary):
    assert created.headers["location"] == summary["links"]["self"]
    assert client.get(created.headers["location"]).json() == summary


def test_volume_and_area_are_those_of_the_ellipsoid(summary):
    ellipsoid, _ = truth()
    assert summary["volume_ml"]["value"] == pytest.approx(ellipsoid.volume_ml, rel=0.05)
    assert summary["area_cm2"]["value"] == pytest.approx(ellipsoid.area_cm2, rel=0.05)
    assert summary["volume_ml"]["low"] < summary["volume_ml"]["value"] < summary["volume_ml"]["high"]


def test_the_summary_holds_what_the_interface_promises(summary):
    assert summary["model"]["name"] == NAME
    assert (summary["space"], summary["unit"], summary["seed"]) == ("RAS", "mm", 5)
    assert summary["fit"]["converged"] is (summary["fit"]["status"] == "converged")
    assert {plane["axis"] for plane in summary["planes"]} == {2}
    assert len(summary["residuals"]) == len(summary["planes"])
    assert 0 < summary["surface_sd"]["mean_mm"] <= summary["surface_sd"]["max_mm"]
    assert 0 <= summary["typicality_percentile"] <= 100


def test_the_surface_lies_where_the_object_is(client, summary):
    ellipsoid, _ = truth()
    mesh = trimesh.load(io.BytesIO(client.get(summary["links"]["mesh"]).content), file_type="ply")
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, [ellipsoid.centre - AXES, ellipsoid.centre + AXES], atol=1.5)


def test_the_segmentation_lies_on_the_inputs_grid(client, summary):
    ellipsoid, grid = truth()
    labels = image(client.get(summary["links"]["segmentation"]))
    np.testing.assert_allclose(labels.affine, grid.affine, atol=1e-5)
    found, right = np.asarray(labels.dataobj) == 1, ellipsoid.mask(grid)
    assert 2 * (found & right).sum() / (found.sum() + right.sum()) > 0.95


def test_the_segmentation_can_have_a_spacing_of_its_own(client, summary):
    ellipsoid, _ = truth()
    labels = image(client.get(summary["links"]["segmentation"], params={"spacing_mm": 0.8}))
    np.testing.assert_allclose(np.linalg.norm(labels.affine[:3, :3], axis=0), 0.8, rtol=1e-5)
    volume_ml = np.count_nonzero(np.asarray(labels.dataobj)) * 0.8**3 / 1000
    assert volume_ml == pytest.approx(ellipsoid.volume_ml, rel=0.05)


def test_occupancy_and_entropy_belong_together(client, summary):
    probability = np.asarray(image(client.get(summary["links"]["occupancy"])).dataobj, float)
    entropy = np.asarray(image(client.get(summary["links"]["uncertainty"])).dataobj, float)
    labels = np.asarray(image(client.get(summary["links"]["segmentation"])).dataobj)
    assert probability.min() >= 0
    assert probability.max() <= 1
    np.testing.assert_array_equal(labels == 1, probability >= 0.5)
    inner = np.clip(probability, 1e-9, 1 - 1e-9)
    np.testing.assert_allclose(entropy, -inner * np.log(inner) - (1 - inner) * np.log1p(-inner), atol=1e-3)


def test_surface_sd_has_a_value_for_each_vertex(client, summary):
    mesh = trimesh.load(io.BytesIO(client.get(summary["links"]["mesh"]).content), file_type="ply", process=False)
    answer = client.get(summary["links"]["surface_sd"]).json()
    assert (answer["space"], answer["unit"]) == ("RAS", "mm")
    assert len(answer["surface_sd_mm"]) == len(mesh.vertices)
    assert np.mean(answer["surface_sd_mm"]) == pytest.approx(summary["surface_sd"]["mean_mm"])


@pytest.mark.parametrize("format", list(MeshFormat))
def test_every_mesh_format_has_its_media_type(client, summary, format):
    answer = client.get(summary["links"]["mesh"], params={"format": format.value})
    assert answer.status_code == 200
    assert answer.headers["content-type"].split(";")[0] == MESH_MEDIA_TYPES[format]
    assert answer.content


def test_a_bound_of_the_error_leaves_fewer_triangles_near_the_surface(client, summary):
    full, fewer = (
        trimesh.load(io.BytesIO(client.get(summary["links"]["mesh"], params=query).content), file_type="ply")
        for query in ({}, {"max_error_mm": 0.2})
    )
    assert len(fewer.faces) < 0.7 * len(full.faces)
    assert fewer.is_watertight
    surfaces = [mesh_of(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, int)) for mesh in (full, fewer)]
    assert hausdorff_mm(*surfaces) <= 0.2 + 1e-4


@pytest.mark.parametrize("error", ["-0.1", "11", "nan"])
def test_an_error_bound_out_of_its_range_is_refused(client, summary, error):
    problem(client.get(summary["links"]["mesh"], params={"max_error_mm": error}), 422)


def test_equal_requests_give_equal_bytes(client, created):
    again = client.post(RECONSTRUCTIONS, files=mask_parts(mask_bytes(AXES)), data={"seed": "5"})
    assert again.json()["id"] != created.json()["id"]
    for part in ("mesh", "segmentation", "occupancy", "uncertainty"):
        first, second = (client.get(answer.json()["links"][part]).content for answer in (created, again))
        assert first == second


@pytest.mark.parametrize("format", DIRECT_FORMATS)
def test_accept_asks_for_the_mesh_itself(client, format):
    media = MESH_MEDIA_TYPES[format]
    answer = client.post(RECONSTRUCTIONS, files=mask_parts(), headers={"Accept": media})
    assert answer.status_code == 200
    assert answer.headers["content-type"].split(";")[0] == media
    assert client.get(answer.headers["content-location"]).content == answer.content


def test_an_unknown_media_type_is_refused_before_any_work(client):
    answer = client.post(RECONSTRUCTIONS, files=mask_parts(b"no image"), headers={"Accept": "text/html"})
    assert "model/stl" in problem(answer, 406)["detail"]


def test_two_stacks_are_one_object_and_the_first_ones_grid_counts(client):
    values, grid = sparse_ellipsoid(AXES)
    ellipsoid, _ = truth()
    across = np.zeros_like(values)
    across[18] = ellipsoid.mask(grid)[18]
    shifted = grid.affine.copy()
    shifted[:3, 3] += (0, 0, 1)
    second = bytes(nib.Nifti1Image(values[:, :, 1:], shifted).to_bytes())
    answer = client.post(RECONSTRUCTIONS, files=mask_parts(nifti_of(across, grid), second))
    assert answer.status_code == 201
    assert {plane["stack"] for plane in answer.json()["planes"]} == {0, 1}
    assert answer.json()["volume_ml"]["value"] == pytest.approx(ellipsoid.volume_ml, rel=0.06)
    assert image(client.get(answer.json()["links"]["segmentation"])).shape == across.shape


def test_named_planes_are_the_ones_that_are_used(client):
    chosen = [{"stack": 0, "axis": 2, "index": index} for index in (8, 12, 16)]
    answer = client.post(RECONSTRUCTIONS, files=mask_parts(), data={"annotated": json.dumps(chosen)})
    assert answer.json()["planes"] == chosen


def test_without_uncertainty_nothing_uncertain_is_offered(client):
    answer = client.post(RECONSTRUCTIONS, files=mask_parts(), data={"uncertainty": "none"}).json()
    assert (answer["surface_sd"], answer["volume_ml"]["low"]) == (None, None)
    assert (answer["links"]["uncertainty"], answer["links"]["surface_sd"]) == (None, None)
    for kind in ("entropy", "surface_sd"):
        refused = client.get(f"{answer['links']['self']}/uncertainty", params={"kind": kind})
        assert problem(refused, 404)["type"].endswith("not-computed")


def test_a_deleted_result_has_no_parts(client):
    links = client.post(RECONSTRUCTIONS, files=mask_parts()).json()["links"]
    assert client.delete(links["self"]).status_code == 204
    for link in links.values():
        assert problem(client.get(link), 404)["type"].endswith("unknown-result")


@pytest.mark.parametrize(
    ("data", "part"),
    [
        ({"colour": "red"}, "colour"),
        ({"seed": "-1"}, "seed"),
        ({"seed": "x"}, "seed"),
        ({"resolution_mm": "0"}, "resolution_mm"),
        ({"resolution_mm": "nan"}, "resolution_mm"),
        ({"fidelity": "nan"}, "fidelity"),
        ({"uncertainty": "much"}, "uncertainty"),
        ({"mirror": "maybe"}, "mirror"),
        ({"annotated": "[]"}, "annotated"),
        ({"annotated": '[{"stack": 4, "axis": 2, "index": 8}]'}, "annotated"),
        ({"label": "zero"}, "label"),
        ({"label": "7"}, "label"),
        ({"model": "spleen"}, "model"),
    ],
)
def test_a_wrong_parameter_is_named(client, data, part):
    answer = problem(client.post(RECONSTRUCTIONS, files=mask_parts(), data=data), 422)
    assert part in answer["part"] + answer["detail"]


def test_an_unknown_field_is_told_the_known_ones(client):
    answer = problem(client.post(RECONSTRUCTIONS, files=mask_parts(), data={"colour": "red"}), 422)
    for name in ("mask", "model", "label", "annotated", "uncertainty", "mirror", "resolution_mm", "seed"):
        assert name in answer["detail"]


def test_a_request_without_a_mask_is_refused(client):
    assert problem(client.post(RECONSTRUCTIONS, files=[("seed", (None, "1"))]), 422)["part"] == "mask"


def test_other_bodies_are_refused(client):
    assert problem(client.post(RECONSTRUCTIONS, json={}), 415)["type"].endswith("unsupported-media-type")
    broken = client.post(RECONSTRUCTIONS, content=b"x", headers={"Content-Type": "multipart/form-data"})
    assert problem(broken, 400)["type"].endswith("malformed-request")


def test_models_are_listed_and_described(client):
    (model,) = client.get("/v1/models").json()["models"]
    described = client.get(model["link"]).json()
    assert described.items() >= model.items()
    assert (described["frame"], described["unit"], described["latent_size"]) == ("RAS", "mm", 3)
    assert problem(client.get("/v1/models/spleen"), 404)["type"].endswith("unknown-model")


def test_probes_and_figures(client, summary):
    client.get(summary["links"]["mesh"])
    assert client.get("/healthz").json() == {"status": "ok"}
    assert client.get("/readyz").json()["models"] == [NAME]
    figures = client.get("/metrics").text
    for stage in ("observations", "fit", "surface", "uncertainty"):
        assert f'morphoflow_stage_seconds_count{{stage="{stage}"}}' in figures
    assert 'route="/v1/reconstructions/{id}/mesh"' in figures
    for name in ("morphoflow_work_waiting", "morphoflow_work_running", "process_resident_memory_bytes"):
        assert f"\n{name} " in figures


def test_the_docs_need_no_other_host(client):
    page = client.get("/docs").text
    assert "https://" not in page
    assert "http://" not in page
    for address in [word.split('"')[1] for word in page.split() if word.startswith(("src=", "href="))]:
        assert client.get(address).status_code == 200


@pytest.mark.parametrize(
    ("method", "path", "status"), [("GET", "/nowhere", 404), ("PUT", "/healthz", 405), ("POST", SAMPLES, 405)]
)
def test_what_is_not_there_is_a_problem_too(client, method, path, status):
    answer = client.request(method, path)
    problem(answer, status)
    assert status != 405 or "GET" in answer.headers["allow"]


def test_a_safe_request_id_comes_back_and_others_are_replaced(client):
    assert client.get("/healthz", headers={"X-Request-ID": "abc-1.2_3"}).headers["x-request-id"] == "abc-1.2_3"
    for unsafe in ("a b", "x" * 65, 'a"b', "<script>"):
        assert client.get("/healthz", headers={"X-Request-ID": unsafe}).headers["x-request-id"] != unsafe
    refused = client.get("/nowhere", headers={"X-Request-ID": "mine"})
    assert refused.json()["request_id"] == "mine"


def test_mean_axes_reconstruct_to_a_typical_shape(client):
    typical = client.post(RECONSTRUCTIONS, files=mask_parts(mask_bytes(MEAN_AXES))).json()
    odd = client.post(RECONSTRUCTIONS, files=mask_parts(mask_bytes((15.5, 6.8, 5.6)))).json()
    assert odd["typicality_percentile"] < typical["typicality_percentile"]


def test_extents_are_those_of_the_ellipsoid(summary):
    found = {extent["along"]: extent for extent in summary["extents"]}
    assert list(found) == ["R", "A", "S", "longest"]
    for along, axis in zip("RAS", AXES, strict=True):
        assert found[along]["extent_mm"]["value"] == pytest.approx(2.0 * axis, rel=0.05)
    assert found["longest"]["extent_mm"]["value"] == pytest.approx(2.0 * max(AXES), rel=0.05)
    assert all(e["extent_mm"]["low"] < e["extent_mm"]["value"] < e["extent_mm"]["high"] for e in found.values())


def test_extents_are_those_that_were_asked_for(client):
    data = {"extents": "0 3 4, S", "uncertainty": "none"}
    found = client.post(RECONSTRUCTIONS, files=mask_parts(), data=data).json()["extents"]
    assert [extent["along"] for extent in found] == ["0 3 4", "S"]
    assert found[0]["direction"] == pytest.approx([0.0, 0.6, 0.8])
    assert found[0]["extent_mm"]["low"] is None
    refused = problem(client.post(RECONSTRUCTIONS, files=mask_parts(), data={"extents": "up"}), 422)
    assert refused["part"] == "extents"


def test_the_legend_spans_the_colours(summary):
    legend = summary["surface_sd"]["legend"]
    assert legend["values_mm"][0] == 0.0
    assert legend["values_mm"][-1] == summary["surface_sd"]["max_mm"]
    assert len(legend["colours"]) == len(legend["values_mm"])


@pytest.mark.parametrize("planes", ["grid", "free"])
def test_the_next_plane_is_one_that_was_not_drawn_and_gains(client, summary, planes):
    found = client.get(summary["links"]["next_plane"], params={"planes": planes}).json()
    assert (found["space"], found["unit"]) == ("RAS", "mm")
    assert found["plane"] not in summary["planes"]
    assert (found["plane"] is None) == (planes == "free")
    assert found["surface_sd_mm"]["now"] == pytest.approx(summary["surface_sd"]["mean_mm"])
    for gain in (found["surface_sd_mm"], found["volume_sd_ml"]):
        assert 0.0 < gain["expected"] < gain["now"]
    ellipsoid, _ = truth()
    assert np.abs(np.array(found["origin_mm"]) - ellipsoid.centre).max() < max(AXES)


@pytest.mark.parametrize("format", ["ply", "stl"])
def test_posterior_shapes_spread_about_the_answer(client, summary, format):
    query = {"count": 6, "seed": 3, "format": format, "spacing_mm": 1.5}
    answer = client.get(summary["links"]["posterior"], params=query)
    archive = zipfile.ZipFile(io.BytesIO(answer.content))
    manifest = json.loads(archive.read("manifest.json"))
    assert archive.namelist() == [*(entry["file"] for entry in manifest["samples"]), "manifest.json"]
    volumes = [entry["volume_ml"] for entry in manifest["samples"]]
    for entry in manifest["samples"]:
        mesh = trimesh.load(io.BytesIO(archive.read(entry["file"])), file_type=format)
        assert abs(mesh.volume) / 1000.0 == pytest.approx(entry["volume_ml"], rel=1e-3)
    value = summary["volume_ml"]
    assert 0.0 < np.std(volumes) < value["high"] - value["low"]
    assert np.mean(volumes) == pytest.approx(value["value"], rel=0.1)
    assert client.get(summary["links"]["posterior"], params={**query, "count": 1, "seed": 5}).status_code == 200


def test_posterior_and_next_plane_need_uncertainty(client):
    links = client.post(RECONSTRUCTIONS, files=mask_parts(), data={"uncertainty": "none"}).json()["links"]
    assert links["posterior"] is None
    assert links["next_plane"] is None
    for part in ("posterior", "next-plane"):
        assert problem(client.get(f"{links['self']}/{part}"), 404)["type"].endswith("not-computed")


def test_too_many_posterior_shapes_are_refused(client, summary):
    assert problem(client.get(summary["links"]["posterior"], params={"count": 10**6}), 413)["part"] == "count"
