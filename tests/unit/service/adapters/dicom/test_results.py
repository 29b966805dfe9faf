"""Results as DICOM objects: valid for other houses' checkers, and the same figures when they are read back."""

import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import highdicom as hd
import numpy as np
import pytest
from pydicom.uid import generate_uid

from model.inference.reconstruction import Options
from model.inference.uncertainty import voxel_entropy
from service import use_cases
from service.adapters.dicom.derivation import Derivation, anatomy_of
from service.adapters.dicom.laterality import SIDES, UNPAIRED
from service.adapters.dicom.masks import stacks_of_object
from service.adapters.dicom.results import RESULTS, result_objects
from service.adapters.dicom.series import series_of
from service.adapters.images import ImageLimits
from service.model_registry import ModelRegistry
from tests.analytic_model import ellipsoid_model
from tests.dicom_parts import PATIENT_ID, checker_errors, file_bytes, grid_of, mr_series, reread, seg_of
from tests.service_parts import sparse_ellipsoid

LIMITS = ImageLimits(max_bytes=1 << 24, max_voxels=1 << 22)
#: When results are made: 2 March 2023, 23:30:15.25 UTC.
MOMENT_S = 1677799815.25


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
    return {name: reread(found) for name, found in result_objects(*derived, MOMENT_S).items()}


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
    again = result_objects(*derive(mr_series()), MOMENT_S)
    other = result_objects(*derive(mr_series(), "another"), MOMENT_S)
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
    for name, found in result_objects(derivation, probability, MOMENT_S).items():
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
    results = result_objects(derivation, probability, MOMENT_S)
    if shutil.which("dciodvfy") is not None:
        assert [error for found in results.values() for error in checker_errors(file_bytes(found), tmp_path)] == []
    (stack,) = stacks_of_object(reread(results["segmentation"]), "mask[0]", LIMITS, home=derivation.series.grid)
    assert (stack.foreground == (probability >= 0.5)).all()


def test_one_structure_of_several_is_told_by_its_number_and_name(derived):
    derivation, probability = derived
    images = mr_series()
    drawn, _ = sparse_ellipsoid(shape=derivation.series.grid.shape)
    both = reread(seg_of(images, np.stack([drawn, drawn], -1), labels=("left", "right")))
    right = replace(derivation, drawing=both, labels=frozenset({2}))
    results = {name: reread(found) for name, found in result_objects(right, probability, MOMENT_S).items()}
    assert all("#2 (" in text for found in results.values() for text in descriptions_of(found))
    assert results["segmentation"].SegmentSequence[0].SegmentLabel == "right"
    assert results["surface"].SegmentSequence[0].SegmentLabel == "right"
    assert (
        hd.sr.Comprehensive3DSR.from_dataset(results["report"])
        .content.get_volumetric_roi_measurement_groups()[0]
        .tracking_identifier
        == "right"
    )


@pytest.mark.parametrize("said_mm", [5.0, 1.02, -1.0])
def test_planes_are_as_far_apart_as_they_lie_whatever_the_images_say(said_mm, tmp_path):
    images = mr_series()
    for image in images:
        image.SpacingBetweenSlices = said_mm
    results = result_objects(*derive(images), MOMENT_S)
    volume = hd.seg.Segmentation.from_dataset(reread(results["segmentation"])).get_volume()
    chart = hd.pm.ParametricMap.from_dataset(reread(results["occupancy"])).get_volume()
    assert volume.spacing == pytest.approx((1.0, 1.0, 1.0))
    assert chart.spacing == pytest.approx((1.0, 1.0, 1.0))
    if shutil.which("dciodvfy") is not None:
        assert [error for found in results.values() for error in checker_errors(file_bytes(found), tmp_path)] == []


def test_results_say_the_side_where_it_is_known(derived, tmp_path):
    derivation, probability = derived
    left = replace(derivation, side="L")
    results = {name: reread(found) for name, found in result_objects(left, probability, MOMENT_S).items()}
    for name in ("segmentation", "surface"):
        (segment,) = results[name].SegmentSequence
        (kind,) = segment.SegmentedPropertyTypeCodeSequence
        assert kind.SegmentedPropertyTypeModifierCodeSequence[0].CodeValue == SIDES["L"].value
        assert segment.SegmentLabel == "ellipsoid, left"
    for name in ("occupancy", "entropy"):
        (anatomy,) = results[name].SharedFunctionalGroupsSequence[0].FrameAnatomySequence
        assert anatomy.FrameLaterality == "L"
    report = hd.sr.Comprehensive3DSR.from_dataset(results["report"])
    (group,) = report.content.get_volumetric_roi_measurement_groups()
    assert group.finding_sites[0].laterality.value == SIDES["L"].value
    if shutil.which("dciodvfy") is not None:
        assert [error for found in results.values() for error in checker_errors(file_bytes(found), tmp_path)] == []


def test_no_side_is_claimed_where_none_is_known(objects):
    for name in ("occupancy", "entropy"):
        assert objects[name].SharedFunctionalGroupsSequence[0].FrameAnatomySequence[0].FrameLaterality == UNPAIRED
    for name in ("segmentation", "surface"):
        (kind,) = objects[name].SegmentSequence[0].SegmentedPropertyTypeCodeSequence
        assert "SegmentedPropertyTypeModifierCodeSequence" not in kind


@pytest.mark.parametrize("labels", [None, frozenset({1})])
def test_the_only_structure_is_called_as_the_model_is(labels, derived):
    assert replace(derived[0], labels=labels).label == "ellipsoid"
    assert "#" not in replace(derived[0], labels=labels).description("Surface")


@pytest.mark.parametrize("number", [1, 999, 1000, 65535])
def test_descriptions_with_a_number_fit_where_the_object_is_cut(number, derived):
    short = replace(derived[0], series=series_of(list(derived[0].series.images[:8])))
    several = reread(derived[0].drawing)
    several.SegmentSequence.append(reread(derived[0].drawing).SegmentSequence[0])
    several.SegmentSequence[1].SegmentNumber = 0
    several.SegmentSequence[0].SegmentNumber = number
    cut = replace(short, drawing=several, labels=frozenset({number}))
    assert cut.is_cut
    assert len(cut.description("Uncertainty maps")) <= 64


@pytest.mark.parametrize(
    ("offset", "date", "time"),
    [("+0530", "20230303", "050015.25"), ("-0800", "20230302", "153015.25"), ("+0000", "20230302", "233015.25")],
)
def test_all_results_are_of_one_moment_in_the_time_zone_of_the_images(offset, date, time, derived):
    found = dated_results(derived, offset)
    assert {(item.InstanceCreationDate, item.ContentDate) for item in found} == {(date, date)}
    assert {(float(item.InstanceCreationTime), float(item.ContentTime)) for item in found} == {(float(time),) * 2}
    assert {item.TimezoneOffsetFromUTC for item in found} == {offset}


@pytest.mark.parametrize("offset", ["", "nonsense"])
def test_without_a_time_zone_of_the_images_results_say_none(offset, derived):
    local = datetime.fromtimestamp(MOMENT_S).strftime("%Y%m%d%H%M%S.%f")
    found = dated_results(derived, offset)
    assert {f"{item.ContentDate}{item.ContentTime}" for item in found} == {local}
    assert {f"{item.InstanceCreationDate}{item.InstanceCreationTime}" for item in found} == {local}
    assert not any("TimezoneOffsetFromUTC" in item for item in found)


def dated_results(derived, offset):
    """The results on images with an offset from UTC, read back."""
    images = [reread(found) for found in mr_series()]
    for image in images:
        if offset:
            image.TimezoneOffsetFromUTC = offset
    derivation = replace(derived[0], series=series_of(images))
    return [reread(found) for found in result_objects(derivation, derived[1], MOMENT_S).values()]


def test_a_drawing_of_another_study_is_referred_to_as_such(derived, tmp_path):
    elsewhere = reread(derived[0].drawing)
    elsewhere.StudyInstanceUID = generate_uid()
    results = result_objects(replace(derived[0], drawing=elsewhere), derived[1], MOMENT_S)
    for name in ("stl", "surface"):
        (study,) = results[name].StudiesContainingOtherReferencedInstancesSequence
        assert study.StudyInstanceUID == elsewhere.StudyInstanceUID
        assert study.ReferencedSeriesSequence[0].SeriesInstanceUID == elsewhere.SeriesInstanceUID
        assert len(results[name].ReferencedSeriesSequence) == 1
        if shutil.which("dciodvfy") is not None:
            assert checker_errors(file_bytes(results[name]), tmp_path) == []
