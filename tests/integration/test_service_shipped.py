"""The models that ship, through the service as it starts by default."""

import gzip

import nibabel as nib
import numpy as np
import pytest

from service.app import create_app
from service.cli import main
from tests.service_parts import mask_parts, running, settings_for


@pytest.fixture(scope="module")
def client(tmp_path_factory, shipped_bundles):
    assert shipped_bundles
    with running(create_app(settings_for(tmp_path_factory.mktemp("shipped"), shipped_models=True))) as client:
        yield client


def dice(left, right):
    return 2 * np.count_nonzero(left & right) / (np.count_nonzero(left) + np.count_nonzero(right))


def volume(data):
    return nib.Nifti1Image.from_bytes(gzip.decompress(data))


def test_all_of_them_are_loaded(client, shipped_bundles):
    answer = client.get("/readyz").json()
    assert (len(answer["models"]), answer["broken"]) == (len(shipped_bundles), [])


def test_a_shape_of_the_model_is_found_again_from_every_fourth_slice(client):
    for model in client.get("/v1/models").json()["models"]:
        query = {"format": "nifti", "spacing_mm": 1.0}
        whole = volume(client.get(f"{model['link']}/samples/3", params=query).content)
        truth = np.asarray(whole.dataobj) > 0
        drawn = np.zeros(truth.shape, np.uint8)
        drawn[:, :, ::4] = truth[:, :, ::4]
        mask = nib.Nifti1Image(drawn, whole.affine).to_bytes()
        made = client.post("/v1/reconstructions", files=mask_parts(mask), data={"model": model["name"]})
        assert made.status_code == 201
        found = volume(client.get(made.json()["links"]["segmentation"]).content)
        assert dice(np.asarray(found.dataobj) == 1, truth) > 0.9


def test_a_real_hippocampus_comes_back_whole(shipped_bundles, shared_data, tmp_path, capsys, monkeypatch):
    assert shipped_bundles
    monkeypatch.delenv("MORPHOFLOW_MODELS", raising=False)
    case = sorted((shared_data / "hippocampus" / "test").glob("*.nii.gz"))[0]
    image = nib.load(case)
    truth = np.asarray(image.dataobj) > 0
    drawn = np.zeros(truth.shape, np.uint8)
    drawn[:, :, ::6] = truth[:, :, ::6]
    nib.save(nib.Nifti1Image(drawn, image.affine), tmp_path / "mask.nii.gz")
    words = ["--model", "hippocampus", "--output", tmp_path / "s.ply", "--segmentation", tmp_path / "d.nii.gz"]
    assert main([str(word) for word in ["reconstruct", tmp_path / "mask.nii.gz", *words, "--json"]]) == 0
    assert '"converged": true' in capsys.readouterr().out
    found = np.asarray(nib.load(tmp_path / "d.nii.gz").dataobj) == 1
    assert dice(found, truth) > 0.75


@pytest.fixture
def femur_slices(shared_data):
    """Three orthogonal slices of a real distal femur (NIfTI)."""
    image = nib.load(sorted((shared_data / "femur" / "test").glob("*.nii.gz"))[0])
    whole = np.asarray(image.dataobj) > 0
    drawn = np.zeros(whole.shape, np.uint8)
    for axis in range(3):
        section = np.moveaxis(whole, axis, 0)
        largest = int(section.sum(axis=(1, 2)).argmax())
        np.moveaxis(drawn, axis, 0)[largest] = section[largest]
    return nib.Nifti1Image(drawn, image.affine).to_bytes()


def test_a_femur_sent_to_the_hippocampus_model_is_answered_and_flagged_over_http(client, femur_slices):
    made = client.post("/v1/reconstructions", files=mask_parts(femur_slices), data={"model": "hippocampus"})
    assert made.status_code == 201
    assert made.json()["typicality_percentile"] < 1.0
    assert any("unlike the population" in sentence for sentence in made.json()["warnings"])


def test_a_femur_sent_to_the_hippocampus_model_is_answered_and_flagged_on_the_command_line(
    femur_slices, tmp_path, capsys
):
    (tmp_path / "mask.nii").write_bytes(femur_slices)
    words = ["reconstruct", tmp_path / "mask.nii", "--model", "hippocampus", "--output", tmp_path / "s.stl", "--json"]
    assert main([str(word) for word in words]) == 0
    assert "unlike the population" in capsys.readouterr().out
    assert (tmp_path / "s.stl").stat().st_size > 1000
