"""Headers that are not quite the standard's: results carry over what was meant, or say what is in the way."""

import io
import json
import shutil
from dataclasses import replace

import highdicom as hd
import pytest
from pydicom import Dataset, dcmread
from pydicom.sequence import Sequence as Items
from pydicom.uid import generate_uid

from model.errors import InputError
from service.adapters.dicom.objects import quiet
from service.adapters.dicom.results import RESULTS, result_objects
from service.adapters.dicom.series import series_of
from tests.dicom_parts import checker_errors, file_bytes, mr_series, reread
from tests.unit.service.adapters.dicom.test_results import MOMENT_S, derive

#: Character sets of images and names that they can spell, with ideographic and phonetic groups.
NAMES = [
    (["", "ISO 2022 IR 87"], "Yamada^Tarou=山田^太郎=やまだ^たろう"),
    (["ISO 2022 IR 6", "ISO 2022 IR 87"], "Yamada^Tarou=山田^太郎=やまだ^たろう"),
    (["ISO 2022 IR 13", "ISO 2022 IR 87"], "ﾔﾏﾀﾞ^ﾀﾛｳ=山田^太郎=やまだ^たろう"),
    (["", "ISO 2022 IR 149"], "Hong^Gildong=洪^吉洞=홍^길동"),
    ("GB18030", "Wang^XiaoDong=王^小东"),
    ("ISO_IR 126", "Διονυσιος"),
    ("ISO_IR 100", "Müller^Jörg"),
    ("ISO_IR 192", "Wang^XiaoDong=王^小東"),
    ("ISO_IR 6", "Plain^Ada"),
    ("", "Plain^Ada"),
    (None, "Plain^Ada"),
]


def from_file(images):
    """The images as they are read from files."""
    return [reread(image) for image in images]


def from_json(images):
    """The headers as they are fetched from an archive."""
    with quiet():
        found = [image.to_json_dict(suppress_invalid_tags=True) for image in from_file(images)]
        return [
            Dataset.from_json(json.loads(json.dumps({k: v for k, v in i.items() if k != "7FE00010"}))) for i in found
        ]


def images_with(**values):
    """A series whose images have other values; without the element where the value is `...`."""
    images = mr_series()
    with quiet():
        for image in images:
            for name, value in values.items():
                delattr(image, name) if value is ... else setattr(image, name, value)
    return images


@pytest.fixture(scope="module")
def derived():
    return derive(mr_series())


def results_on(images, derived):
    """The results of the same drawing with the headers of other images, read back from their files."""
    derivation, probability = derived
    found = result_objects(replace(derivation, series=series_of(images)), probability, MOMENT_S)
    return {name: file_bytes(item) for name, item in found.items()}


def errors_of(files, folder):
    if shutil.which("dciodvfy") is None:
        return []
    return [(name, error) for name, data in files.items() for error in checker_errors(data, folder)]


@pytest.mark.parametrize("route", [from_file, from_json])
@pytest.mark.parametrize(("character_set", "name"), NAMES)
def test_names_come_out_right_from_every_character_set(character_set, name, route, derived, tmp_path):
    images = images_with(SpecificCharacterSet=character_set, PatientName=name, StudyDescription="x")
    other = Dataset()
    other.PatientID, other.TypeOfPatientID, other.IssuerOfPatientID = "7", "TEXT", name.split("=")[-1].replace("^", " ")
    for image in images:
        image.OtherPatientIDsSequence = Items([other])
    files = results_on(route(images), derived)
    assert set(files) == set(RESULTS)
    for data in files.values():
        found = reread_bytes(data)
        assert found.SpecificCharacterSet == "ISO_IR 192"
        assert str(found.PatientName) == name
        groups = (found.PatientName.alphabetic, found.PatientName.ideographic, found.PatientName.phonetic)
        assert "=".join(groups).rstrip("=") == name
        assert found.OtherPatientIDsSequence[0].IssuerOfPatientID == other.IssuerOfPatientID
    assert errors_of(files, tmp_path) == []


def reread_bytes(data):
    return dcmread(io.BytesIO(data))


@pytest.mark.parametrize("route", [from_file, from_json])
@pytest.mark.parametrize(
    ("name", "written", "carried"),
    [
        ("PatientBirthDate", "00000000", ""),
        ("PatientBirthDate", "1990.01.31", "19900131"),
        ("PatientBirthDate", "1990-01-31", "19900131"),
        ("PatientBirthDate", "31.01.1990", ""),
        ("PatientBirthDate", "19900231", ""),
        ("PatientBirthDate", "19900131", "19900131"),
        ("StudyDate", "2024.01.02", "20240102"),
        ("StudyDate", "", ""),
        ("StudyTime", "03:04:05", "030405"),
        ("StudyTime", "03:04:05.25", "030405.25"),
        ("StudyTime", "25:00:00", ""),
        ("StudyTime", "0304", "0304"),
        ("StudyTime", "235960", "235960"),
        ("StudyTime", "morning", ""),
        ("PatientSex", "female", ""),
        ("PatientSex", "f", "F"),
        ("PatientAge", "45", ""),
        ("PatientAge", "045Y", "045Y"),
    ],
)
def test_values_of_old_forms_are_converted_and_others_emptied(name, written, carried, route):
    for image in series_of(route(images_with(**{name: written}))).images:
        assert (image.get(name) or "") == carried


@pytest.mark.parametrize(
    "values",
    [
        {"PatientBirthDate": "00000000"},
        {"StudyTime": "03:04:05"},
        {"StudyDate": "2024.01.02"},
        {"PatientAge": "45"},
        {"SliceThickness": ...},
        {"SliceThickness": None},
        {"SliceThickness": 0},
        {"PatientName": ..., "PatientID": ..., "PatientSex": ..., "StudyTime": ..., "StudyID": ...},
    ],
)
def test_what_is_made_of_imperfect_headers_passes_the_checker(values, derived, tmp_path):
    files = results_on(from_json(images_with(**values)), derived)
    assert errors_of(files, tmp_path) == []


@pytest.mark.parametrize("thickness", [..., None, 0, -1])
def test_the_distance_of_the_planes_stands_in_for_a_thickness(thickness):
    images = mr_series(spacing=(1.0, 1.0, 2.5))
    for image in images:
        image.SliceThickness = None if thickness is ... else thickness
        if thickness is ...:
            del image.SliceThickness
    assert {float(image.SliceThickness) for image in series_of(images).images} == {2.5}
    kept = mr_series(spacing=(1.0, 1.0, 2.5))
    for image in kept:
        image.SliceThickness = 2.0
    assert {float(image.SliceThickness) for image in series_of(kept).images} == {2.0}


def test_multi_frame_images_may_say_direction_and_spacing_in_each_frame(derived, tmp_path):
    images = mr_series()
    for image in images:
        image.WindowCenter, image.WindowWidth = 40, 400
    enhanced = reread(hd.legacy.LegacyConvertedEnhancedMRImage(images, generate_uid(), 5, generate_uid(), 1))
    shared = enhanced.SharedFunctionalGroupsSequence[0]
    del shared.PixelMeasuresSequence[0].SliceThickness
    for frame in enhanced.PerFrameFunctionalGroupsSequence:
        for name in ("PlaneOrientationSequence", "PixelMeasuresSequence"):
            frame[name] = shared[name]
    del shared.PlaneOrientationSequence, shared.PixelMeasuresSequence
    files = results_on([enhanced], derived)
    measures = reread_bytes(files["segmentation"]).SharedFunctionalGroupsSequence[0].PixelMeasuresSequence[0]
    assert float(measures.SliceThickness) == pytest.approx(1.0)
    assert errors_of(files, tmp_path) == []
    assert "PlaneOrientationSequence" not in enhanced.SharedFunctionalGroupsSequence[0]


def test_directions_that_differ_by_rounding_are_said_alike(derived):
    images = mr_series()
    images[3].ImageOrientationPatient = [1, 0, 1e-9, 0, 1, 0]
    assert set(results_on(images, derived)) == set(RESULTS)


def test_the_images_themselves_stay_as_they_are():
    images = images_with(StudyTime="03:04:05", PatientSex=..., SliceThickness=...)
    before = [file_bytes(image) for image in images]
    series = series_of(images)
    assert [file_bytes(image) for image in images] == before
    assert all(image.StudyTime == "030405" for image in series.images)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"FrameOfReferenceUID": ...}, r"FrameOfReferenceUID \(0020,0052\).* is accepted"),
        ({"StudyInstanceUID": ""}, r"StudyInstanceUID \(0020,000D\).* is accepted"),
        ({"PatientID": ["1", "2"]}, r"PatientID \(0010,0020\).* is accepted"),
        ({"PatientName": ["A^B", "C^D"]}, r"PatientName \(0010,0010\).* is accepted"),
    ],
)
def test_what_cannot_be_used_is_named(values, told):
    with pytest.raises(InputError, match=told) as refused:
        series_of(from_file(images_with(**values)))
    assert "SECRET" not in str(refused.value)


def test_images_of_several_studies_are_no_series():
    images = mr_series()
    images[2].StudyInstanceUID = generate_uid()
    with pytest.raises(InputError, match=r"StudyInstanceUID \(0020,000D\)"):
        series_of(images)


@pytest.mark.parametrize(("declared", "refused"), [("ISO_IR 999", True), ("ISO_IR 192", True), ("ISO-IR 100", False)])
def test_names_that_could_only_be_guessed_are_refused(declared, refused):
    written = [file_bytes(i) for i in images_with(SpecificCharacterSet="ISO_IR 100", PatientName="Müller^Jörg")]
    with quiet():
        images = [reread_bytes(data.replace(b"ISO_IR 100", declared.encode().ljust(10))) for data in written]
    if not refused:
        assert {str(image.PatientName) for image in series_of(images).images} == {"Müller^Jörg"}
        return
    with pytest.raises(InputError, match=r"PatientName \(0010,0010\).*SpecificCharacterSet \(0008,0005\)") as told:
        series_of(images)
    assert "ller" not in str(told.value)


def test_an_unknown_character_set_of_plain_names_is_no_hindrance():
    with quiet():
        images = from_file(images_with(SpecificCharacterSet="ISO_IR 999"))
    assert {str(image.PatientName) for image in series_of(images).images} == {"Zweig^Ada"}
