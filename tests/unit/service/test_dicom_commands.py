"""Studies as training data without identifiers; trails that are whole."""

import copy
import hashlib
import io
import json
import shutil

import nibabel as nib
import numpy as np
import pytest
from pydicom import Dataset, dcmread
from pydicom.encaps import encapsulate
from pydicom.sequence import Sequence as Items
from pydicom.uid import JPEG2000Lossless, MediaStorageDirectoryStorage

from service.adapters.blobs import FolderBlobs
from service.adapters.dicom.profile import apply_profile
from service.adapters.pacs.audit import AuditEntry, AuditEvent, AuditTrail, TrailCheck, check_trail
from service.adapters.pacs.inbox import ARGUMENT, INBOX, QUARANTINE, quarantine
from service.cli import main
from tests.dicom_parts import (
    PATIENT_ID,
    PATIENT_NAME,
    checker_errors,
    file_bytes,
    grid_of,
    mr_series,
    reread,
    ring,
    rtstruct_of,
    seg_of,
)

SIZE = (16, 14, 8)
SECRETS = (PATIENT_NAME, PATIENT_ID, "19610503", "20240102", "ACC-77", "Doc^Tor", "Hidden")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A study on disk, with what is drawn in it and its grid."""
    folder = tmp_path_factory.mktemp("study")
    images = mr_series(SIZE)
    values = np.zeros(SIZE, np.uint8)
    values[4:9, 3:10, 2:6] = 1
    drawn = seg_of(images, values)
    images[0].add_new(0x00091001, "LO", "Hidden")
    contours = rtstruct_of(images, [("CLOSED_PLANAR", ring(images, n, (3.0,))[0]) for n in (2, 5)])
    for number, found in enumerate([*images, drawn, contours]):
        (folder / f"{PATIENT_ID}-{number:02d}.dcm").write_bytes(file_bytes(found))
    (folder / "notes.txt").write_text(PATIENT_NAME)
    return folder, values, grid_of(images)


@pytest.fixture(scope="module")
def output(study, tmp_path_factory):
    target = tmp_path_factory.mktemp("training") / "case"
    assert main(["deidentify", str(study[0]), "--output", str(target)]) == 0
    return target


def test_no_identifier_is_left_in_files_or_names(study, output):
    originals = [dcmread(path) for path in study[0].glob("*.dcm")]
    secrets = [*SECRETS, *{image.SOPInstanceUID for image in originals}, originals[0].StudyInstanceUID]
    files = [path for path in output.rglob("*") if path.is_file()]
    assert len(files) == len(originals) + 2
    for path in files:
        content = path.read_bytes()
        assert not [secret for secret in secrets if secret.encode() in content or secret in str(path)]


def test_drawings_still_refer_to_their_images(output):
    objects = [dcmread(path) for path in sorted((output / "dicom").iterdir())]
    images = {found.SOPInstanceUID for found in objects if found.Modality == "MR"}
    (drawing,) = [found for found in objects if found.Modality == "SEG"]
    referenced = drawing.ReferencedSeriesSequence[0].ReferencedInstanceSequence
    assert {item.ReferencedSOPInstanceUID for item in referenced} <= images
    assert {found.StudyInstanceUID for found in objects} == {drawing.StudyInstanceUID}
    assert all(found.PatientIdentityRemoved == "YES" for found in objects)
    assert all(found.DeidentificationMethodCodeSequence[0].CodeValue == "113100" for found in objects)


def test_drawings_become_label_maps_on_their_images(study, output):
    first, second = (nib.Nifti1Image.from_filename(path) for path in sorted((output / "masks").iterdir()))
    assert (np.asarray(first.dataobj) == study[1]).all()
    assert np.asarray(first.affine) == pytest.approx(study[2].affine)
    held = np.flatnonzero(np.asarray(second.dataobj).any(axis=(0, 1)))
    assert held.tolist() == [2, 5]


@pytest.mark.parametrize(
    "words", [["none", "--output", "x"], ["{study}", "--output", "{study}"], ["{empty}", "--output", "x"]]
)
def test_slips_are_told(words, study, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    filled = [word.format(study=study[0], empty=tmp_path / "empty") for word in words]
    assert main(["deidentify", *filled]) == 2
    assert PATIENT_ID not in capsys.readouterr().err


def test_a_whole_trail_and_a_broken_one(tmp_path, capsys):
    path = tmp_path / "audit.jsonl"
    for _ in range(3):
        AuditTrail(path).write(AuditEntry(AuditEvent.STARTED, "A", "A"))
    assert main(["audit", str(path)]) == 0
    assert "whole" in capsys.readouterr().out
    whole = path.read_bytes()
    path.write_bytes(whole[:-40])
    assert main(["audit", str(path)]) == 0
    told = capsys.readouterr()
    assert "line 3" in told.err
    assert "whole" in told.out
    path.write_bytes(whole[300:])
    assert main(["audit", str(path)]) == 2
    assert "line 1" in capsys.readouterr().err
    assert main(["audit", str(tmp_path / "none")]) == 2


RULES = """
[[archives]]
name = "a"
dicomweb = "http://127.0.0.1:1/dicom-web"
[[rules]]
name = "one"
model = "hippocampus"
segment_labels = ["hippo*"]
senders = ["VIEWER"]
fetch_from = "a"
send_to = ["a"]
"""


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Files of a service among archives."""
    (tmp_path / "pacs.toml").write_text(RULES)
    monkeypatch.setenv("MORPHOFLOW_PACS_FILE", str(tmp_path / "pacs.toml"))
    monkeypatch.setenv("MORPHOFLOW_RESULTS_FOLDER", str(tmp_path / "results"))
    return FolderBlobs(tmp_path / "files")


@pytest.fixture(scope="module")
def pair() -> bytes:
    """A drawing of a left and a right structure."""
    values = np.zeros((*SIZE, 2), np.uint8)
    values[2:6, 3:10, 2:6, 0] = values[9:13, 3:10, 2:6, 1] = 1
    return file_bytes(seg_of(mr_series(SIZE), values, labels=("hippo left", "hippo right")))


def test_drawings_in_quarantine_are_taken_up_again(files, pair, tmp_path, capsys):
    quarantine(files, "a", pair, "The archive refused a result.", {"sender": "VIEWER"})
    quarantine(files, "b", pair, "The archive refused a result.", {"sender": "NOBODY"})
    damaged = hashlib.sha256(b"nonsense").hexdigest()
    quarantine(files, damaged, b"nonsense", "It is damaged.", {"sender": "VIEWER"})
    assert main(["resend", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"taken": ["a"], "left": sorted(["b", damaged])}
    asked = [json.loads(files.get(key)) for key in files.list(f"{INBOX}/") if key.endswith(ARGUMENT)]
    assert {key.split("/")[2] for key in files.list(f"{QUARANTINE}/")} == {"b", damaged}
    assert sorted((job["labels"], job["sender"]) for job in asked) == [([1], "VIEWER"), ([2], "VIEWER")]
    assert check_trail(tmp_path / "audit.jsonl") == TrailCheck(None)


def test_slips_of_resend_are_told(files, pair, monkeypatch, capsys):
    quarantine(files, "a", pair, "The archive refused a result.", {"sender": "VIEWER"})
    assert main(["resend", "a", "none"]) == 2
    assert "no folder none" in capsys.readouterr().err
    assert list(files.list(f"{INBOX}/")) == []
    monkeypatch.delenv("MORPHOFLOW_PACS_FILE")
    assert main(["resend"]) == 2
    assert "MORPHOFLOW_PACS_FILE" in capsys.readouterr().err


def test_the_profile_keeps_segmentations_valid(study, output, tmp_path):
    drawings = [
        path
        for folder in (study[0], output / "dicom")
        for path in folder.glob("*.dcm")
        if dcmread(path).Modality == "SEG"
    ]
    if shutil.which("dciodvfy") is None:
        pytest.skip("dciodvfy (Debian: dicom3tools) is not installed")
    assert [checker_errors(path.read_bytes(), tmp_path) for path in drawings] == [[], []]


def items_of(found, name):
    """Every item of the sequences of one name, however deep."""
    return [item for element in found.iterall() if element.keyword == name for item in element.value]


def test_references_within_sequences_keep_their_class_and_get_the_new_uids(output):
    objects = [dcmread(path) for path in sorted((output / "dicom").iterdir())]
    images = {found.SOPInstanceUID: found.SOPClassUID for found in objects if found.Modality == "MR"}
    (drawing,) = [found for found in objects if found.Modality == "SEG"]
    for name in ("SourceImageSequence", "ReferencedInstanceSequence"):
        items = items_of(drawing, name)
        assert items
        assert all(images[item.ReferencedSOPInstanceUID] == item.ReferencedSOPClassUID for item in items)
    purposes = {item.CodeValue: item.CodeMeaning for item in items_of(drawing, "PurposeOfReferenceCodeSequence")}
    assert purposes["121322"] == "Source image for image processing operation"


def test_segments_are_called_by_their_code(output):
    (drawing,) = [found for found in map(dcmread, (output / "dicom").iterdir()) if found.Modality == "SEG"]
    assert [item.SegmentLabel for item in drawing.SegmentSequence] == ["Hippocampus"]


TYPED = "Zweig"


def with_texts(folder):
    """An image and a drawing that have a name wherever somebody can type one."""
    images = mr_series(SIZE)
    values = np.zeros(SIZE, np.uint8)
    values[4:9, 3:10, 2:6] = 1
    drawn = reread(seg_of(images, values, labels=(TYPED,)))
    drawn.ContentDescription = drawn.SegmentSequence[0].SegmentDescription = TYPED
    drawn.SegmentSequence[0].TrackingID, drawn.ContentLabel = TYPED, TYPED.upper()
    image = images[0]
    image.add_new(0x60000010, "US", 1)
    image.add_new(0x60000022, "LO", TYPED)
    image.add_new(0x60001500, "LO", TYPED)
    image.add_new(0x60024000, "LT", TYPED)
    image.FrameOfInterestDescription = image.PlacerOrderNumberProcedure = TYPED
    item = Dataset()
    item.RequestedProcedureDescription = item.PatientID = TYPED
    image.ScheduledStepAttributesSequence = Items([item])
    image.add_new(0x00181FF1, "UN", TYPED.encode() + b" ")
    image.AcquisitionDateTime = "20240102030405"
    meta = image.file_meta
    meta.SourceApplicationEntityTitle = meta.SendingApplicationEntityTitle = TYPED
    meta.PrivateInformationCreatorUID, meta.PrivateInformation = "1.2.3", TYPED.encode() + b"!"
    image.preamble = TYPED.encode() + b"\0" * 123
    for number, found in enumerate((image, drawn)):
        (folder / f"{number}.dcm").write_bytes(file_bytes(found))


def test_no_typed_text_is_left(tmp_path):
    (tmp_path / "study").mkdir()
    with_texts(tmp_path / "study")
    assert main(["deidentify", str(tmp_path / "study"), "--output", str(tmp_path / "out")]) == 0
    written = sorted((tmp_path / "out" / "dicom").iterdir())
    assert not [path for path in written if TYPED.lower().encode() in path.read_bytes().lower()]
    image = dcmread(written[0])
    assert not [element for element in image if element.tag.group & 0xFF00 == 0x6000]
    assert {element.keyword for element in image.file_meta} - {"ImplementationVersionName"} == {
        *("FileMetaInformationGroupLength", "FileMetaInformationVersion", "TransferSyntaxUID"),
        *("MediaStorageSOPClassUID", "MediaStorageSOPInstanceUID", "ImplementationClassUID"),
    }
    assert image.file_meta.MediaStorageSOPInstanceUID == image.SOPInstanceUID
    if shutil.which("dciodvfy") is not None:
        before = [checker_errors(path.read_bytes(), tmp_path) for path in sorted((tmp_path / "study").iterdir())]
        after = [checker_errors(path.read_bytes(), tmp_path) for path in written]
        assert [set(new) - set(old) for old, new in zip(before, after, strict=True)] == [set(), set()]


def test_sequences_of_the_table_are_removed_or_emptied_whole():
    found, item = Dataset(), Dataset()
    item.ReferencedSOPClassUID, item.ReferencedSOPInstanceUID = "1.2.840.10008.5.1.4.1.1.4", "1.2.3.4"
    for name in ("InstitutionCodeSequence", "ReferencedStudySequence", "ReferencedPerformedProcedureStepSequence"):
        setattr(found, name, Items([copy.deepcopy(item)]))
    apply_profile(found)
    assert "InstitutionCodeSequence" not in found
    assert len(found.ReferencedStudySequence) == 0
    (step,) = found.ReferencedPerformedProcedureStepSequence
    assert step.ReferencedSOPClassUID == item.ReferencedSOPClassUID
    assert step.ReferencedSOPInstanceUID != item.ReferencedSOPInstanceUID


def run(folder, output, capsys):
    """Exit status, the JSON document if there is one, and what was said."""
    status = main(["deidentify", str(folder), "--output", str(output), "--json"])
    told = capsys.readouterr()
    return status, json.loads(told.out) if told.out else None, told.err


def test_a_directory_of_media_is_passed_over(tmp_path, capsys):
    (tmp_path / "disc").mkdir()
    images = mr_series(SIZE)
    for image in images:
        (tmp_path / "disc" / f"{image.InstanceNumber:06d}").write_bytes(file_bytes(image))
    directory = Dataset()
    directory.FileSetID, directory.DirectoryRecordSequence = "DISC", Items([])
    directory.file_meta = copy.deepcopy(images[0].file_meta)
    directory.file_meta.MediaStorageSOPClassUID = MediaStorageDirectoryStorage
    (tmp_path / "disc" / "DICOMDIR").write_bytes(file_bytes(directory))
    status, done, told = run(tmp_path / "disc", tmp_path / "out", capsys)
    assert (status, told) == (0, "")
    assert done == {"objects": SIZE[2], "label_maps": 0, "masks": [], "unused_files": [], "unused_drawings": []}


def test_files_that_cannot_be_used_are_named_and_the_others_written(tmp_path, capsys):
    study = tmp_path / "study"
    (study / "other").mkdir(parents=True)
    images = mr_series(SIZE)
    packed = copy.deepcopy(images[0])
    packed.file_meta.TransferSyntaxUID = JPEG2000Lossless
    packed.PixelData = encapsulate([b"\0" * 10])
    packed["PixelData"].is_undefined_length = True
    nameless = copy.deepcopy(images[0])
    nameless.preamble = b"\0" * 128
    del nameless.SOPInstanceUID
    odd = copy.deepcopy(images[0])
    odd.add_new("PatientID", "OW", b"12")
    content = {"a": images[1], "other/packed": packed, "other/odd": odd}
    for name, found in content.items():
        (study / f"{name}.dcm").write_bytes(file_bytes(found))
    buffer = io.BytesIO()
    nameless.save_as(buffer)
    (study / "nameless.dcm").write_bytes(buffer.getvalue())
    status, done, told = run(study, tmp_path / "out", capsys)
    assert (status, done["objects"]) == (0, 1)
    reasons = {item["file"]: item["reason"] for item in done["unused_files"]}
    assert set(reasons) == {"nameless.dcm", "other/odd.dcm", "other/packed.dcm"}
    assert "transfer syntax" in reasons["other/packed.dcm"]
    assert "SOPInstanceUID (0008,0018)" in reasons["nameless.dcm"]
    assert all(f"not used: {name}: {reason}" in told for name, reason in reasons.items())
    assert len(list((tmp_path / "out" / "dicom").iterdir())) == 1


def test_nothing_is_written_of_a_study_without_usable_files(tmp_path, capsys):
    study = tmp_path / "study"
    study.mkdir()
    data = file_bytes(mr_series(SIZE)[0])
    (study / "cut.dcm").write_bytes(data[:300])
    status, done, told = run(study, tmp_path / "out", capsys)
    assert (status, done) == (2, None)
    assert "not used: cut.dcm: " in told
    assert not (tmp_path / "out").exists()


def test_drawings_without_a_label_map_are_named_with_the_reason(tmp_path, capsys):
    study = tmp_path / "study"
    study.mkdir()
    images = mr_series(SIZE)
    contours = rtstruct_of(images, [("CLOSED_PLANAR", ring(images, n, (3.0,))[0]) for n in (2, 5)])
    opened = rtstruct_of(images, [("OPEN_PLANAR", ring(images, 2, (3.0,))[0])])
    strays = rtstruct_of(others := mr_series(SIZE), [("CLOSED_PLANAR", ring(others, 2, (3.0,))[0])])
    for name, found in {"drawn": contours, "open": opened, "stray": strays}.items():
        (study / f"{name}.dcm").write_bytes(file_bytes(found))
    for number, image in enumerate(images):
        (study / f"image-{number}.dcm").write_bytes(file_bytes(image))
    status, done, told = run(study, tmp_path / "out", capsys)
    assert (status, done["label_maps"], done["unused_files"]) == (0, 1, [])
    reasons = {item["file"]: item["reason"] for item in done["unused_drawings"]}
    assert set(reasons) == {"open.dcm", "stray.dcm"}
    assert "no closed planar contour" in reasons["open.dcm"]
    assert "no images" in reasons["stray.dcm"]
    assert all(f"no label map: {name}: {reason}" in told for name, reason in reasons.items())
    assert main(["deidentify", str(study), "--output", str(tmp_path / "again")]) == 0
    assert "2 drawings without a label map" in capsys.readouterr().out


def test_drawings_on_an_irregular_series_are_told(study, tmp_path, capsys):
    (tmp_path / "study").mkdir()
    for path in study[0].glob("*.dcm"):
        if dcmread(path).get("InstanceNumber") != 4 or dcmread(path).Modality != "MR":
            (tmp_path / "study" / path.name.rpartition("-")[2]).write_bytes(path.read_bytes())
    status, done, told = run(tmp_path / "study", tmp_path / "out", capsys)
    assert (status, done["label_maps"], len(done["unused_drawings"])) == (0, 0, 2)
    assert told.count("no label map: ") == 2


def test_removed_dates_are_stated(output):
    objects = [dcmread(path) for path in (output / "dicom").iterdir()]
    assert {found.LongitudinalTemporalInformationModified for found in objects} == {"REMOVED"}


def test_addresses_of_objects_are_removed():
    found, item = Dataset(), Dataset()
    for name in ("RetrieveURL", "RetrieveURI", "FileAccessURI"):
        setattr(found, name, "https://pacs.example/studies/1.2.3")
        setattr(item, name, "https://pacs.example/studies/1.2.3")
    found.ReferencedInstanceSequence = Items([item])
    apply_profile(found)
    assert "pacs.example" not in str(found)
