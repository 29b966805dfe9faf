"""Which images a drawing wants."""

import numpy as np
import pytest
from pydicom import Dataset
from pydicom.sequence import Sequence as Items
from pydicom.uid import generate_uid

from service.adapters.dicom.masks import referenced_series, referenced_studies
from service.adapters.pacs.references import referenced_images
from tests.dicom_parts import mr_series, reread, ring, rtstruct_of, seg_of

SIZE = (12, 10, 8)


@pytest.fixture(scope="module")
def images():
    return mr_series(SIZE)


def uids(images) -> set[str]:
    return {str(image.SOPInstanceUID) for image in images}


def test_a_segmentation_wants_the_instances_of_its_series(images):
    drawn = np.zeros(SIZE, np.uint8)
    drawn[3:6, 3:6, 3:6] = 1
    drawing = reread(seg_of(images, drawn))
    assert referenced_images(drawing, str(images[0].SeriesInstanceUID)) == uids(images)
    assert referenced_images(drawing, "1.2.3") == set()
    del drawing.ReferencedSeriesSequence[0].ReferencedInstanceSequence
    assert referenced_images(drawing, str(images[0].SeriesInstanceUID)) == set()


def test_the_study_of_the_images_may_be_another_than_the_drawings(images):
    drawn = np.zeros(SIZE, np.uint8)
    drawn[3:6, 3:6, 3:6] = 1
    drawing = reread(seg_of(images, drawn))
    own, series = generate_uid(), str(images[0].SeriesInstanceUID)
    assert referenced_studies(drawing, series) == (images[0].StudyInstanceUID,)
    study = Dataset()
    study.StudyInstanceUID, study.ReferencedSeriesSequence = drawing.StudyInstanceUID, drawing.ReferencedSeriesSequence
    drawing.StudiesContainingOtherReferencedInstancesSequence = Items([study])
    del drawing.ReferencedSeriesSequence
    drawing.StudyInstanceUID = own
    assert referenced_studies(drawing, series) == (own, images[0].StudyInstanceUID)
    assert referenced_images(drawing, series) == uids(images)
    assert referenced_series(drawing) == series


def test_a_structure_set_names_the_study_of_its_images(images):
    drawing = rtstruct_of(images, [("CLOSED_PLANAR", ring(images, 3, (2.0,))[0])])
    own, series = generate_uid(), str(images[0].SeriesInstanceUID)
    drawing.StudyInstanceUID = own
    assert referenced_studies(drawing, series) == (own,)
    study = drawing.ReferencedFrameOfReferenceSequence[0].RTReferencedStudySequence[0]
    study.ReferencedSOPInstanceUID = images[0].StudyInstanceUID
    assert referenced_studies(drawing, series) == (own, images[0].StudyInstanceUID)


def on(contour: Dataset, image: Dataset) -> None:
    item = Dataset()
    item.ReferencedSOPClassUID, item.ReferencedSOPInstanceUID = image.SOPClassUID, image.SOPInstanceUID
    contour.ContourImageSequence = Items([item])


def test_a_structure_set_wants_the_listed_images_and_those_of_its_contours(images):
    others = mr_series(SIZE)
    drawing = rtstruct_of(images[:4], [("CLOSED_PLANAR", ring(images, number, (2.0,))[0]) for number in (5, 6)])
    more = rtstruct_of(others, [])
    drawing.ReferencedFrameOfReferenceSequence.append(more.ReferencedFrameOfReferenceSequence[0])
    first, second = drawing.ROIContourSequence[0].ContourSequence
    on(first, images[5])
    on(second, others[6])
    assert referenced_images(drawing, str(images[0].SeriesInstanceUID)) == uids([*images[:4], images[5]])
    assert referenced_images(drawing, str(others[0].SeriesInstanceUID)) == uids([*others, images[5]])
