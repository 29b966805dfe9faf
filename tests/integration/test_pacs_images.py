"""Images as archives have them: compressed, in another study, of many classes, or not to be had."""

import io
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from pydicom import Dataset, dcmread
from pydicom.encaps import encapsulate
from pydicom.uid import (
    JPEG2000,
    EnhancedUSVolumeStorage,
    JPEG2000Lossless,
    JPEGLosslessSV1,
    NuclearMedicineImageStorage,
    generate_uid,
)

from benchmarks.pacs.orthanc import is_installed
from service.adapters.dicom.results import RESULTS
from service.adapters.pacs.archives import open_archive
from service.adapters.pacs.configuration import MoveDestination
from service.adapters.pacs.dimse_client import DimseArchive
from tests.dicom_parts import file_bytes, mr_series, reread
from tests.pacs_archives import FakeArchive
from tests.pacs_parts import by_get, by_move, drawn_series, put_images, service_with

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("sockets_of_refused_peers")]
beside_orthanc = pytest.mark.skipif(not is_installed(), reason="Orthanc is not installed (Debian: orthanc dcmtk)")


def kept_as(image: Dataset, syntax: str) -> Dataset:
    """An image whose pixels nobody can decode, so that an archive sends it as it is or not at all."""
    found = dcmread(io.BytesIO(file_bytes(image)))
    found.file_meta.TransferSyntaxUID = syntax
    found.PixelData = encapsulate([b"\0" * 10])
    found["PixelData"].is_undefined_length = True
    return found


@beside_orthanc
@pytest.mark.parametrize("way", ["C-GET", "C-MOVE"])
def test_compressed_images_are_fetched_as_they_are(way, orthanc, ports):
    syntaxes = (JPEG2000Lossless, JPEG2000, JPEGLosslessSV1)
    images = [kept_as(image, syntaxes[number % 3]) for number, image in enumerate(mr_series((12, 10, 6)))]
    for image in images:
        orthanc.client.post("/instances", content=file_bytes(image)).raise_for_status()
    archive = open_archive(by_get(orthanc) if way == "C-GET" else by_move(orthanc, ports.own))
    found = archive.images(images[0].StudyInstanceUID, images[0].SeriesInstanceUID)
    assert found.failed == 0
    assert {image.SOPInstanceUID for image in found.images} == {image.SOPInstanceUID for image in images}


@beside_orthanc
@pytest.mark.parametrize("way", ["C-GET", "C-MOVE"])
@pytest.mark.parametrize("kind", [NuclearMedicineImageStorage, EnhancedUSVolumeStorage])
def test_images_of_other_classes_are_fetched(kind, way, orthanc, ports, tmp_path):
    images = [reread(image) for image in mr_series((12, 10, 3))]
    for image in images:
        image.SOPClassUID = image.file_meta.MediaStorageSOPClassUID = kind
    put_images(orthanc, tmp_path, images)
    archive = open_archive(by_get(orthanc) if way == "C-GET" else by_move(orthanc, ports.own))
    found = archive.images(images[0].StudyInstanceUID, images[0].SeriesInstanceUID)
    assert len(found.images) == len(images)


@beside_orthanc
def test_retrievals_to_one_port_wait_for_each_other(orthanc, ports, tmp_path):
    series = [mr_series((12, 10, 4)) for _ in range(4)]
    for images in series:
        put_images(orthanc, tmp_path, images)

    def fetched(images: Sequence[Dataset]) -> set[str]:
        archive = open_archive(by_move(orthanc, ports.own))
        found = archive.images(images[0].StudyInstanceUID, images[0].SeriesInstanceUID)
        return {str(image.SOPInstanceUID) for image in found.images}

    with ThreadPoolExecutor(4) as pool:
        answers = list(pool.map(fetched, series))
    assert answers == [{str(image.SOPInstanceUID) for image in images} for images in series]


class UnableArchive(FakeArchive):
    """Has the images, and answers every retrieval with a failure."""

    def _get(self, _: Any) -> Iterator[Any]:
        yield 1
        yield 0xA702, None


class StrangeArchive(FakeArchive):
    """Knows no destination to move images to."""

    def _move(self, _: Any) -> Iterator[Any]:
        yield None, None


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        (UnableArchive, "The archive could not send the images: status A702."),
        (StrangeArchive, "The archive does not know the title that images are to be moved to."),
    ],
)
def test_an_archive_that_can_never_send_images_is_not_asked_for_ever(kind, reason, ports, tmp_path):
    images, drawing = drawn_series()
    destination = MoveDestination(ae_title="MORPHOMOVE", port=ports.own) if kind is StrangeArchive else None
    archive = kind(images, destination=destination)
    service = service_with(tmp_path, archive.settings())
    service.configuration = service.configuration.model_copy(update={"images_awaited_s": 0.3})
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with archive.running(), service.working():
        service.until_empty()
    assert service.reasons() == [reason]


def moved_to_another_study(drawing: Dataset) -> Dataset:
    """The drawing in a study of its own; it names that of its images."""
    found, study = reread(drawing), Dataset()
    study.StudyInstanceUID, study.ReferencedSeriesSequence = found.StudyInstanceUID, found.ReferencedSeriesSequence
    found.StudiesContainingOtherReferencedInstancesSequence = [study]
    del found.ReferencedSeriesSequence
    found.StudyInstanceUID = generate_uid()
    return found


class StudiousArchive(FakeArchive):
    """Knows which study its images are of."""

    def _find(self, event: Any) -> Iterator[tuple[int, Dataset | None]]:
        if event.identifier.StudyInstanceUID == self.images[0].StudyInstanceUID:
            yield from super()._find(event)
        else:
            yield 0x0000, None


def test_a_drawing_may_be_in_another_study_than_its_images(tmp_path):
    images, drawing = drawn_series()
    archive = StudiousArchive(images)
    service = service_with(tmp_path, archive.settings())
    service.inbox.receive(file_bytes(moved_to_another_study(drawing)), "VIEWER")
    with archive.running(), service.working():
        service.until_empty()
    assert service.reasons() == []
    assert len(archive.results) == len(RESULTS)
    assert {found.StudyInstanceUID for found in archive.results} == {images[0].StudyInstanceUID}


def test_a_drawing_of_one_patient_gets_no_images_of_another(tmp_path):
    images, drawing = drawn_series()
    other = moved_to_another_study(drawing)
    other.PatientID = "SOMEBODY-ELSE"
    archive = StudiousArchive(images)
    service = service_with(tmp_path, archive.settings())
    service.inbox.receive(file_bytes(other), "VIEWER")
    with archive.running(), service.working():
        service.until_empty()
    assert ["different patients" in reason for reason in service.reasons()] == [True]
    assert archive.stored == []


def test_an_archive_that_tells_no_classes_is_asked_for_all_kinds_of_images():
    images = mr_series((12, 10, 3))
    archive = FakeArchive(images)
    with archive.running():
        found = DimseArchive(archive.settings()).images(images[0].StudyInstanceUID, images[0].SeriesInstanceUID)
    assert len(found.images) == len(images)
