"""Studies as training data without identifiers; trails that are whole."""

import nibabel as nib
import numpy as np
import pytest
from pydicom import dcmread

from service.adapters.pacs.audit import AuditEntry, AuditEvent, AuditTrail
from service.cli import main
from tests.dicom_parts import (
    PATIENT_ID,
    PATIENT_NAME,
    checker_errors,
    file_bytes,
    grid_of,
    mr_series,
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
    path.write_bytes(path.read_bytes()[300:])
    assert main(["audit", str(path)]) == 2
    assert "line 1" in capsys.readouterr().err
    assert main(["audit", str(tmp_path / "none")]) == 2


def test_the_profile_keeps_segmentations_valid(output, tmp_path):
    (drawing,) = [path for path in (output / "dicom").iterdir() if dcmread(path).Modality == "SEG"]
    assert not [error for error in checker_errors(drawing.read_bytes(), tmp_path) if "Missing" in error]
