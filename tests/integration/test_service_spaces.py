"""In which world answers are told: a drawing in DICOM and the same one in NIfTI differ by the signs of x and y."""

import io
import json
import re
import zipfile

import numpy as np
import pytest
import trimesh

from tests.dicom_parts import file_bytes, grid_of, mr_series, seg_of
from tests.service_parts import app_for, nifti_of, problem, running, sparse_ellipsoid

RECONSTRUCTIONS = "/v1/reconstructions"
TO_LPS = np.array([-1.0, -1.0, 1.0])
ASKED = {"extents": "R, A, S, longest, 0.6 0 0.8", "seed": "3"}
#: The same direction of the body as the last one, in numbers of the other world.
ASKED_IN_LPS = {**ASKED, "extents": "R, A, S, longest, -0.6 0 0.8"}


@pytest.fixture(scope="module")
def app(tmp_path_factory):
    return app_for(tmp_path_factory.mktemp("spaces"))


@pytest.fixture(scope="module")
def client(app):
    with running(app) as client:
        yield client


@pytest.fixture(scope="module")
def masks():
    """One drawing, as NIfTI and as a segmentation object on the images."""
    images = mr_series()
    volume, _ = sparse_ellipsoid((13.0, 9.0, 8.0), every=1)
    return nifti_of(volume, grid_of(images)), file_bytes(seg_of(images, volume, omit_empty_frames=False))


@pytest.fixture(scope="module")
def answers(client, masks):
    """The summaries of both."""
    return [reconstructed(client, form, mask) for form, mask in zip((ASKED, ASKED_IN_LPS), masks, strict=True)]


def reconstructed(client, form, *masks):
    answer = client.post(RECONSTRUCTIONS, files=[("mask", ("m", mask)) for mask in masks], data=form)
    assert answer.status_code == 201, answer.text
    return answer.json()


def surface(response):
    """Space that a PLY names, and its vertices."""
    assert response.status_code == 200
    found = re.search(rb"comment space (\w+)", response.content)
    return found.group(1).decode(), np.array(trimesh.load(io.BytesIO(response.content), "ply", process=False).vertices)


def test_every_answer_says_its_world(answers):
    assert [answer["space"] for answer in answers] == ["RAS", "LPS"]


def test_figures_are_the_same_and_coordinates_are_turned(answers):
    ras, lps = answers
    for figure in ("volume_ml", "area_cm2"):
        assert lps[figure]["value"] == pytest.approx(ras[figure]["value"], rel=1e-6)
    np.testing.assert_allclose(lps["pose"]["position_mm"], TO_LPS * ras["pose"]["position_mm"], atol=1e-6)
    np.testing.assert_allclose(lps["pose"]["rotation"], np.array(ras["pose"]["rotation"]) * TO_LPS, atol=1e-9)
    for there, here in zip(lps["extents"], ras["extents"], strict=True):
        assert there["extent_mm"]["value"] == pytest.approx(here["extent_mm"]["value"], rel=1e-6)
        np.testing.assert_allclose(there["direction"], TO_LPS * here["direction"], atol=1e-6)
    assert lps["extents"][0]["direction"] == [-1.0, 0.0, 0.0]
    assert lps["extents"][-1]["direction"] == pytest.approx([-0.6, 0.0, 0.8])


@pytest.mark.parametrize(
    "path", ["mesh?format=ply", "mesh?format=ply&max_error_mm=0.2", "comparison?other={0}", "interpolation?with={0}"]
)
def test_surfaces_are_told_in_the_inputs_world(client, answers, path):
    there, here = (surface(client.get(f"{a['links']['self']}/{path.format(a['id'])}")) for a in reversed(answers))
    assert (there[0], here[0]) == ("LPS", "RAS")
    np.testing.assert_allclose(there[1], TO_LPS * here[1], atol=1e-4)


@pytest.mark.parametrize("path", ["mesh?format=ply", "comparison?other={0}&format=ply"])
def test_a_surface_may_be_asked_for_in_either_world(client, answers, path):
    for answer in answers:
        place = f"{answer['links']['self']}/{path.format(answers[0]['id'])}"
        ras, lps = (surface(client.get(f"{place}&space={space}")) for space in ("RAS", "LPS"))
        assert (ras[0], lps[0]) == ("RAS", "LPS")
        np.testing.assert_allclose(lps[1], TO_LPS * ras[1], atol=1e-4)
        assert problem(client.get(f"{place}&space=LAS"), 422)["part"] == "space"


def test_a_mesh_as_the_answer_is_told_in_the_inputs_world(client, masks, answers):
    headers, files = {"Accept": "application/x-ply"}, {"mask": ("m", masks[1])}
    made = client.post(RECONSTRUCTIONS, files=files, data=ASKED_IN_LPS, headers=headers)
    space, vertices = surface(made)
    assert space == "LPS"
    np.testing.assert_allclose(vertices, surface(client.get(answers[1]["links"]["mesh"]))[1], atol=1e-6)
    np.testing.assert_array_equal(vertices, surface(client.get(made.headers["content-location"]))[1])


def test_parts_of_a_result_say_their_world(client, answers):
    for answer in answers:
        links = answer["links"]
        assert client.get(links["surface_sd"]).json()["space"] == answer["space"]
        batch = client.get(links["posterior"], params={"count": 1, "format": "ply"})
        with zipfile.ZipFile(io.BytesIO(batch.content)) as archive:
            manifest = json.loads(archive.read("manifest.json"))
            written = archive.read(manifest["samples"][0]["file"])
        assert manifest["space"] == answer["space"]
        assert f"comment space {answer['space']}".encode() in written
        way = client.get(f"{links['self']}/interpolation", params={"with": answer["id"], "steps": 2})
        with zipfile.ZipFile(io.BytesIO(way.content)) as archive:
            assert json.loads(archive.read("manifest.json"))["space"] == answer["space"]


def test_the_next_plane_is_told_in_the_inputs_world(client, answers):
    ras, lps = (client.get(answer["links"]["next_plane"], params={"planes": "free"}).json() for answer in answers)
    assert (ras["space"], lps["space"]) == ("RAS", "LPS")
    np.testing.assert_allclose(lps["normal"], TO_LPS * ras["normal"], atol=1e-3)
    np.testing.assert_allclose(lps["origin_mm"], TO_LPS * ras["origin_mm"], atol=1e-2)


def test_volumes_are_nifti_and_lie_in_ras_whatever_the_input(client, answers):
    first, second = (client.get(answer["links"]["segmentation"], params={"spacing_mm": 2.0}) for answer in answers)
    assert first.content == second.content


def test_a_mixture_is_told_in_ras(client, masks):
    answer = reconstructed(client, {**ASKED, "uncertainty": "none"}, *reversed(masks))
    assert answer["space"] == "RAS"
    assert answer["extents"][0]["direction"] == [1.0, 0.0, 0.0]


def test_planes_before_a_reconstruction_are_told_in_ras(client, masks):
    told = [client.post("/v1/planes", files={"mask": ("m", mask)}).json() for mask in masks]
    assert [answer["space"] for answer in told] == ["RAS", "RAS"]
    np.testing.assert_allclose(told[0]["stacks"][0]["affine"], told[1]["stacks"][0]["affine"], atol=1e-6)


def test_a_kept_result_says_the_same_when_it_is_read_again(client, answers):
    for answer in answers:
        assert client.get(answer["links"]["self"]).json() == answer
