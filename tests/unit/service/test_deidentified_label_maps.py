"""Label maps of a study without identifiers: which structure is which number."""

import json

import nibabel as nib
import numpy as np
import pytest
from pydicom import Dataset, dcmread
from pydicom.sequence import Sequence as Items

from service.adapters.dicom.deidentification import without_pixels
from tests.dicom_parts import file_bytes, mr_series, reread, ring, rtstruct_of, seg_of, with_region
from tests.unit.service.test_dicom_commands import SIZE, TYPED, run


def written_study(folder, images, drawings):
    """Files of images and drawings, which are named so that they come first."""
    folder.mkdir()
    for number, found in enumerate([*drawings, *images]):
        (folder / f"{number:03d}.dcm").write_bytes(file_bytes(found))
    return folder


def masks_of(output, done):
    """Voxels of each label map that a run told of."""
    return [np.asarray(nib.Nifti1Image.from_filename(output / item["file"]).dataobj) for item in done["masks"]]


def coded(keyword, value, meaning):
    item = Dataset()
    item.CodeValue, item.CodingSchemeDesignator, item.CodeMeaning = value, "SCT", meaning
    holder = Dataset()
    setattr(holder, keyword, Items([item]))
    return holder


@pytest.fixture
def boxes():
    """Three boxes beside each other, by number."""
    values = np.zeros((*SIZE, 3), np.uint8)
    values[1:4, 3:10, 2:6, 0] = values[5:8, 3:10, 1:6, 1] = values[10:13, 3:10, 2:7, 2] = 1
    return values


@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP"])
def test_each_segment_has_a_number_of_its_own(kind, boxes, tmp_path, capsys):
    boxes[..., 1] = 0  # of the second segment there is nothing
    images = mr_series(SIZE)
    drawn = reread(seg_of(images, boxes, kind, labels=(TYPED, "nothing", TYPED)))
    side = coded("SegmentedPropertyTypeModifierCodeSequence", "24028007", "Right")
    kinds = drawn.SegmentSequence[-1].SegmentedPropertyTypeCodeSequence[0]
    kinds.SegmentedPropertyTypeModifierCodeSequence = side.SegmentedPropertyTypeModifierCodeSequence
    study = written_study(tmp_path / "study", images, [drawn])
    status, done, _ = run(study, tmp_path / "out", capsys)
    (mask,) = masks_of(tmp_path / "out", done)
    assert (status, done["label_maps"]) == (0, 1)
    assert (mask == boxes[..., 0] + 2 * boxes[..., 2]).all()
    assert done["masks"] == [
        {
            "file": "masks/000000.nii.gz",
            "drawing": "dicom/000000.dcm",
            "structures": [
                {"value": 1, "number": 1, "meaning": "Hippocampus"},
                {"value": 2, "number": 3, "meaning": "Hippocampus, Right"},
            ],
        }
    ]
    assert dcmread(tmp_path / "out" / "dicom" / "000000.dcm").Modality == "SEG"


def test_segments_that_overlap_are_label_maps_by_themselves(boxes, tmp_path, capsys):
    boxes[3, 3:10, 2:6, 1] = 1
    images = mr_series(SIZE)
    drawn = seg_of(images, boxes, labels=("one", "two", "three"))
    _, done, _ = run(written_study(tmp_path / "study", images, [drawn]), tmp_path / "out", capsys)
    masks = masks_of(tmp_path / "out", done)
    assert done["label_maps"] == len(masks) == 3
    for number, (mask, item) in enumerate(zip(masks, done["masks"], strict=True), 1):
        assert (mask == boxes[..., number - 1]).all()
        assert item["structures"] == [{"value": 1, "number": number, "meaning": "Hippocampus"}]
        assert item["drawing"] == "dicom/000000.dcm"


def test_each_region_has_a_number_of_its_own_and_no_name_is_told(tmp_path, capsys):
    images = mr_series(SIZE)

    def region(number, shift):
        contours = [ring(images, n, (1.6,))[0] + np.array([shift, 0.0, 0.0]) for n in (2, 5)]
        found = rtstruct_of(images, [("CLOSED_PLANAR", contour) for contour in contours])
        found.StructureSetROISequence[0].ROIName = TYPED
        found.StructureSetROISequence[0].ROINumber = found.ROIContourSequence[0].ReferencedROINumber = number
        return found

    # Numbers that no label of a request can have are those of regions all the same.
    both = with_region(region(0, -3.0), region(255, 3.0), 255)
    observed = coded("RTROIIdentificationCodeSequence", "5366008", "Hippocampus")
    observed.ReferencedROINumber, observed.ROIObservationLabel = 255, TYPED
    both.RTROIObservationsSequence = Items([observed])
    _, done, told = run(written_study(tmp_path / "study", images, [both]), tmp_path / "out", capsys)
    (mask,) = masks_of(tmp_path / "out", done)
    assert [item["structures"] for item in done["masks"]] == [
        [{"value": 1, "number": 0, "meaning": ""}, {"value": 2, "number": 255, "meaning": "Hippocampus"}]
    ]
    assert np.unique(mask).tolist() == [0, 1, 2]
    assert np.argwhere(mask == 1)[:, 0].max() < np.argwhere(mask == 2)[:, 0].min()
    assert TYPED not in json.dumps(done) + told


def test_images_are_kept_without_pixels_and_drawings_whole():
    images = mr_series(SIZE)
    drawing = seg_of(images, np.ones((*SIZE, 1), np.uint8))
    assert "PixelData" not in without_pixels(reread(images[0]))
    assert "PixelData" in without_pixels(reread(drawing))
