"""What a summary warns of that lies in the files and the steps of a request, over HTTP with the analytic model."""

import re

import nibabel as nib
import numpy as np
import pytest

from tests.dicom_parts import file_bytes, mr_series, seg_of
from tests.service_parts import app_for, image, mask_bytes, problem, running, sparse_ellipsoid

RECONSTRUCTIONS = "/v1/reconstructions"
CUT = "beyond the grid of the first mask"


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running(app_for(tmp_path_factory.mktemp("warnings"))) as client:
        yield client


def reconstructed(client, *masks, **form):
    answer = client.post(RECONSTRUCTIONS, files=[("mask", ("m", mask)) for mask in masks], data=form)
    assert answer.status_code == 201, answer.text
    return answer.json()


def warned(summary, words):
    """The warnings with these words."""
    return [sentence for sentence in summary["warnings"] if words in sentence]


def labelled_ml(client, summary, **query):
    labels = image(client.get(summary["links"]["segmentation"], params=query))
    return np.count_nonzero(np.asarray(labels.dataobj)) * abs(np.linalg.det(labels.affine[:3, :3])) / 1000


@pytest.mark.parametrize("empty_frames", [True, False])
def test_a_segmentation_without_empty_frames_has_no_room_for_the_ends(client, empty_frames):
    drawn, _ = sparse_ellipsoid()
    mask = file_bytes(seg_of(mr_series(), drawn, omit_empty_frames=not empty_frames))
    found = reconstructed(client, mask)
    told, whole_ml = warned(found, CUT), found["volume_ml"]["value"]
    assert bool(told) is not empty_frames
    assert labelled_ml(client, found, spacing_mm=1) == pytest.approx(whole_ml, rel=0.02)
    share = labelled_ml(client, found) / whole_ml
    if empty_frames:
        assert share == pytest.approx(1.0, rel=0.02)
    else:
        assert share < 0.95
        assert int(re.search(r"show (\d+) %", told[0])[1]) == pytest.approx(100 * share, abs=3)


def test_a_guessed_orientation_is_told_before_and_after(client):
    bare = nib.Nifti1Image(sparse_ellipsoid()[0], None)
    told = warned(reconstructed(client, mask_bytes(), bare.to_bytes(), uncertainty="none"), "declares no orientation")
    assert [sentence.partition(" ")[0] for sentence in told] == ["mask[1]"]
    before = client.post("/v1/planes", files=[("mask", ("m", mask)) for mask in (mask_bytes(), bare.to_bytes())])
    assert before.json()["warnings"] == told


def test_voxels_in_another_unit_are_blamed_on_the_mask(client):
    metres = nib.Nifti1Image.from_bytes(mask_bytes())
    metres.header.set_xyzt_units("meter")
    told = problem(client.post(RECONSTRUCTIONS, files={"mask": ("m", metres.to_bytes())}), 422)
    assert (told["type"], told["part"]) == ("urn:morphoflow:problem:invalid-mask", "mask[0]")
    assert "in mm" in told["detail"]


@pytest.mark.parametrize(("step_mm", "told"), [(1.0, False), (1.1, False), (6.0, True)])
def test_figures_do_not_depend_on_a_coarse_step(client, step_mm, told):
    plain, found = (
        reconstructed(client, mask_bytes(), uncertainty="none", **form) for form in ({}, {"resolution_mm": step_mm})
    )
    assert found["volume_ml"]["value"] == pytest.approx(plain["volume_ml"]["value"], rel=1e-3)
    assert bool(warned(found, "figures are measured at")) is told
