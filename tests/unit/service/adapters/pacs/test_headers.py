"""What an object is, in whichever transfer syntax and however damaged."""

import io

import numpy as np
import pytest
from pydicom import dcmread
from pydicom.encaps import encapsulate
from pydicom.uid import DeflatedExplicitVRLittleEndian, JPEG2000Lossless

from service.adapters.pacs import headers
from service.adapters.pacs.headers import header_of
from tests.dicom_parts import file_bytes, mr_series, reread, seg_of

SIZE = (12, 10, 8)


@pytest.fixture(scope="module")
def images():
    return mr_series(SIZE)


@pytest.fixture(scope="module")
def drawing(images):
    drawn = np.zeros(SIZE, np.uint8)
    drawn[3:6, 3:6, 3:6] = 1
    return reread(seg_of(images, drawn))


def test_images_are_foreign_in_any_syntax(images):
    image = reread(images[0])
    image.file_meta.TransferSyntaxUID = JPEG2000Lossless
    image.PixelData = encapsulate([b"\0" * 10])
    image["PixelData"].is_undefined_length = True
    for found in (images[0], image):
        header = header_of(file_bytes(found))
        assert header.is_foreign
        assert (header.sop_class, header.sop_instance) == (image.SOPClassUID, image.SOPInstanceUID)
        assert header.study == image.StudyInstanceUID


def test_drawings_are_not_unless_this_program_made_them(drawing):
    assert not header_of(file_bytes(drawing)).is_foreign
    assert not header_of(file_bytes(drawing)[132:]).is_foreign  # without the preamble
    own = reread(drawing)
    own.Manufacturer = "MorphoFlow"
    assert header_of(file_bytes(own)).is_foreign


def test_a_deflated_object_is_not_inflated(images):
    image = reread(images[0])
    image.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    data = file_bytes(image)
    assert dcmread(io.BytesIO(data)).StudyInstanceUID == image.StudyInstanceUID
    header = header_of(data)
    assert header.is_foreign
    assert header.sop_instance == image.SOPInstanceUID
    assert header.study == ""  # which stands in the deflated part alone


@pytest.mark.parametrize("data", [b"", b"nonsense", b"\0" * 128 + b"DICM", b"\0" * 128 + b"DICM" + b"nonsense"])
def test_of_nonsense_nothing_is_said(data):
    assert header_of(data) == headers.Header("", "", "", is_foreign=False)


def test_a_file_that_breaks_off_is_recognised_by_its_beginning(images, drawing):
    assert header_of(file_bytes(images[0])[:500]).is_foreign
    assert not header_of(file_bytes(drawing)[:500]).is_foreign
