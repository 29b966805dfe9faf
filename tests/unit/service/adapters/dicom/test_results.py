"""Results as DICOM objects: valid for other houses' checkers, and the same figures when they are read back."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import highdicom as hd
import numpy as np
import pytest
from pydicom.uid import generate_uid

from model.inference.reconstruction import Options
from model.inference.uncertainty import voxel_entropy
from service import use_cases
from service.adapters.dicom.derivation import Derivation, anatomy_of
from service.adapters.dicom.masks import stacks_of_object
from service.adapters.dicom.results import RESULTS, result_objects
from service.adapters.dicom.series import series_of
from service.adapters.images import ImageLimits
from service.model_registry import ModelRegistry
from tests.analytic_model import ellipsoid_model
from tests.dicom_parts import PATIENT_ID, checker_errors, file_bytes, grid_of, mr_series, reread, seg_of
from tests.service_parts import sparse_ellipsoid

LIMITS = ImageLimits(max_bytes=1 << 24, max_voxels=1 << 22)


def derive(images, key: str = "the same"):
    """A drawn ellipsoid, what the analytic model makes of it, and the occupancy on the images' grid."""
    model = ellipsoid_model("ellipsoid")
    series = series_of(images)
    drawn, _ = sparse_ellipsoid(shape=series.grid.shape)
    drawing = reread(seg_of(images, drawn))
    stacks = stacks_of_object(drawing, "mask[0]", LIMITS, home=series.grid)
    outcome = use_cases.reconstruct(model, stacks, Options())
    derivation = Derivation(drawing, series, outcome, anatomy_of(model.manifest), key, "0.1.0")
    volume = use_cases.probability_map(ModelRegistry({"ellipsoid": model}), outcome, None, 1 << 22)
    return derivation, volume.array


@pytest.fixture(scope="module")
def derived():
    return derive(mr_series())


@pytest.fixture(scope="module")
def objects(derived):
    return {name: reread(found) for name, found in result_objects(*derived).items()}


@pytest.mark.parametrize("name", RESULTS)
def test_the_checker_finds_no_error(name, objects, tmp_path):
    if shutil.which("dciodvfy") is None:
        pytest.skip("dciodvfy (Debian: dicom3tools) is not installed")
    assert checker_errors(file_bytes(objects[name]), tmp_path) == []


def test_all_are_of_the_study_and_none_is_of_the_series(objects, derived):
    image = derived[0].series.images[0]
    for name, found in objects.items():
        assert found.StudyInstanceUID == image.StudyInstanceUID
        assert found.PatientID == PATIENT_ID
        assert found.SeriesInstanceUID not in (image.SeriesInstanceUID, derived[0].drawing.SeriesInstanceUID)
        assert "not for primary diagnosis" in found.SeriesDescription, name
        assert found.get("FrameOfReferenceUID", image.FrameOfReferenceUID) == image.FrameOfReferenceUID
    assert len({found.SOPInstanceUID for found in objects.values()}) == len(RESULTS)


def test_identifiers_are_the_same_for_the_same_work_and_others_for_other_work(objects):
    again = result_objects(*derive(mr_series()))
    other = result_objects(*derive(mr_series(), "another"))
    for name, found in objects.items():
        assert again[name].SOPInstanceUID == found.SOPInstanceUID != other[name].SOPInstanceUID


def test_the_segmentation_is_the_probable_part_on_the_frames(objects, derived):
    (stack,) = stacks_of_object(objects["segmentation"], "mask[0]", LIMITS, home=derived[0].series.grid)
    assert (stack.foreground == (derived[1] >= 0.5)).all()
    sources = {image.SOPInstanceUID for image in derived[0].series.images}
    referenced = objects["segmentation"].ReferencedSeriesSequence[0].ReferencedInstanceSequence
    assert {item.ReferencedSOPInstanceUID for item in referenced} <= sources


@pytest.mark.parametrize(("name", "values"), [("occupancy", lambda p: p), ("entropy", voxel_entropy)])
def test_maps_hold_their_values(name, values, objects, derived):
    found = hd.pm.ParametricMap.from_dataset(objects[name])
    volume = found.get_volume(dtype=np.float64)
    expected = np.moveaxis(values(derived[1].astype(float)), (0, 1, 2), (2, 1, 0))
    forward = volume.affine[:3, 0] @ [0.0, 0.0, 1.0] > 0
    assert np.abs(volume.array[:: 1 if forward else -1] - expected).max() < 1e-6


def test_the_report_holds_the_figures(objects, derived):
    answer = derived[0].outcome.reconstruction
    found = hd.sr.Comprehensive3DSR.from_dataset(objects["report"])
    (group,) = found.content.get_volumetric_roi_measurement_groups()
    figures = {item.name.meaning: item.value for item in group.get_measurements()}
    assert figures["Volume"] == pytest.approx(answer.volume_ml.value, rel=1e-5)
    assert figures["Surface Area of Mesh"] == pytest.approx(answer.area_cm2.value, rel=1e-5)
    assert group.reference_type.meaning == "Referenced Segment"
    text = objects["report"].to_json()
    assert f"bundle_sha256={derived[0].outcome.model_digest}" in text
    assert "+, range of upper measurement uncertainty" in text


def test_both_surfaces_are_the_mesh_in_patient_coordinates(objects, derived):
    mesh = derived[0].outcome.reconstruction.mesh
    (surface,) = objects["surface"].SurfaceSequence
    points = np.frombuffer(surface.SurfacePointsSequence[0].PointCoordinatesData, "<f4").reshape(-1, 3)
    assert points == pytest.approx(mesh.vertices * [-1, -1, 1], abs=1e-3)
    triangles = np.frombuffer(surface.SurfaceMeshPrimitivesSequence[0].LongTrianglePointIndexList, "<u4")
    corners = points[triangles.reshape(-1, 3) - 1].astype(float)
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6000
    assert volume == pytest.approx(derived[0].outcome.reconstruction.volume_ml.value, rel=1e-3)
    stl = objects["stl"].EncapsulatedDocument[: objects["stl"].EncapsulatedDocumentLength]
    assert np.frombuffer(stl[80:84], "<u4")[0] == len(mesh.faces)
    facets = np.frombuffer(stl[84:], np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")]))["v"]
    assert np.sort(facets.reshape(-1, 3).min(axis=0)) == pytest.approx(np.sort(points.min(axis=0)), abs=1e-3)


def test_a_cut_object_says_so(derived):
    images = mr_series(size=(36, 30, 26))[:13]
    derivation, probability = derive(images)
    short = mr_series(size=(36, 30, 13))
    assert not derived[0].is_cut
    assert Derivation(derivation.drawing, series_of(short[:6]), derivation.outcome, derivation.anatomy, "k", "0").is_cut
    assert probability.shape == derivation.series.grid.shape


def descriptions_of(found):
    """Every description in an object and its items."""
    names = ("SeriesDescription", "ContentDescription", "DocumentTitle", "ImageComments")
    for element in found.iterall():
        if element.keyword in names:
            yield element.value


@pytest.mark.parametrize("cut", [False, True])
def test_every_description_is_whole_and_fits(cut, derived):
    derivation, probability = derived
    if cut:
        short = series_of(list(derivation.series.images[:8]))
        derivation, probability = replace(derivation, series=short), probability[:, :, :8]
    assert derivation.is_cut is cut
    for name, found in result_objects(derivation, probability).items():
        told = list(descriptions_of(reread(found)))
        assert told, name
        for text in told:
            assert len(text) <= 64
            assert "not for primary diagnosis" in text
            assert text.endswith(")")
            assert ("CUT at border" in text) is cut


def dcmqi(program: str) -> str:
    path = Path(sys.executable).with_name(program)
    if not path.exists():
        pytest.skip("dcmqi is not installed")
    return str(path)


def test_dcmqi_reads_segmentation_report_and_maps(objects, tmp_path):
    for name in ("segmentation", "entropy", "report"):
        (tmp_path / f"{name}.dcm").write_bytes(file_bytes(objects[name]))
    commands = [
        [
            dcmqi("segimage2itkimage"),
            "--inputDICOM",
            "segmentation.dcm",
            "--outputDirectory",
            ".",
            "--outputType",
            "nii",
        ],
        [dcmqi("paramap2itkimage"), "--inputDICOM", "entropy.dcm", "--outputDirectory", ".", "--outputType", "nii"],
        [dcmqi("tid1500reader"), "--inputDICOM", "report.dcm", "--outputMetadata", "report.json"],
    ]
    for command in commands:
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stdout + run.stderr


def test_multi_frame_images_are_a_series_as_well(tmp_path):
    images = mr_series()
    for image in images:
        image.WindowCenter, image.WindowWidth = 40, 400
    enhanced = hd.legacy.LegacyConvertedEnhancedMRImage(images, generate_uid(), 5, generate_uid(), 1)
    derivation, probability = derive([reread(enhanced)])
    assert derivation.series.grid.coincides_with(grid_of(images))
    results = result_objects(derivation, probability)
    if shutil.which("dciodvfy") is not None:
        assert [error for found in results.values() for error in checker_errors(file_bytes(found), tmp_path)] == []
    (stack,) = stacks_of_object(reread(results["segmentation"]), "mask[0]", LIMITS, home=derivation.series.grid)
    assert (stack.foreground == (probability >= 0.5)).all()
