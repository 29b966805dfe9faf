"""What makes two drawings of one identifier different, and what does not."""

from dataclasses import replace

import highdicom as hd
import numpy as np
import pytest
from pydicom.uid import RLELossless

from service.adapters.dicom.masks import stacks_of_object
from service.adapters.image_guard import ImageLimits
from service.adapters.pacs.contents import content_digest
from tests.dicom_parts import grid_of, mr_series, reread, ring, rtstruct_of, seg_of, two_boxes

SIZE = (12, 10, 8)
LIMITS = ImageLimits(max_bytes=1 << 20, max_voxels=1 << 20)


@pytest.fixture(scope="module")
def images():
    return mr_series(SIZE)


@pytest.fixture(scope="module")
def drawing(images):
    return reread(seg_of(images, two_boxes(SIZE), "LABELMAP", labels=("left", "right")))


def segment_of(found, number):
    return next(item for item in found.SegmentSequence if item.SegmentNumber == number)


def digest_of(images, found, labels=None) -> str:
    return content_digest(found, stacks_of_object(found, "object", LIMITS, labels, grid_of(images)), labels)


def test_the_form_of_a_drawing_and_its_patient_do_not_count(images, drawing):
    packed, renamed = reread(drawing), reread(drawing)
    packed.compress(RLELossless, generate_instance_uid=False)
    renamed.PatientName, renamed.StudyDescription, renamed.ContentDate = "Other^Name", "Other", "20250101"
    assert {digest_of(images, found) for found in (packed, renamed)} == {digest_of(images, drawing)}


def test_other_voxels_are_other_content(images, drawing):
    changed = reread(drawing)
    values = np.array(drawing.pixel_array)
    values[0, 0, 0] = 1
    changed.PixelData = values.tobytes()
    assert digest_of(images, changed) != digest_of(images, drawing)


@pytest.mark.parametrize("labels", [None, frozenset({1})])
def test_other_names_and_codes_are_other_content(labels, images, drawing):
    named, coded = reread(drawing), reread(drawing)
    segment_of(named, 1).SegmentLabel = "LEFT"
    kind = segment_of(coded, 1).SegmentedPropertyTypeCodeSequence[0]
    kind.SegmentedPropertyTypeModifierCodeSequence = [hd.sr.CodedConcept("7771000", "SCT", "Left")]
    assert len({digest_of(images, found, labels) for found in (drawing, named, coded)}) == 3


def test_what_changes_of_other_structures_does_not_count(images, drawing):
    changed = reread(drawing)
    segment_of(changed, 2).SegmentLabel = "RIGHT"
    assert digest_of(images, changed, frozenset({1})) == digest_of(images, drawing, frozenset({1}))
    assert digest_of(images, drawing, frozenset({1})) != digest_of(images, drawing, frozenset({2}))


def test_the_place_of_voxels_counts_but_no_rounding_of_it(images, drawing):
    stacks = stacks_of_object(drawing, "object", LIMITS, None, grid_of(images))

    def moved(by_mm: float) -> str:
        affine = stacks[0].grid.affine.copy()
        affine[0, 3] += by_mm
        return content_digest(drawing, [replace(stacks[0], grid=replace(stacks[0].grid, affine=affine)), *stacks[1:]])

    assert moved(1e-12) == moved(0.0) != moved(0.01)


def test_other_contours_are_other_content(images):
    one, other = (rtstruct_of(images, [("CLOSED_PLANAR", ring(images, 3, (size,))[0])]) for size in (2.0, 4.0))
    assert digest_of(images, one) == digest_of(images, reread(one)) != digest_of(images, other)
