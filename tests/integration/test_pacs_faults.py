"""Archives that are late, fail, forget or do not know the service any more."""

import http.server
import threading
from contextlib import AbstractContextManager

import pytest

from benchmarks.ports import free_ports
from service.adapters.dicom.results import RESULTS
from service.adapters.pacs.commitment import COMMITMENTS
from service.adapters.pacs.configuration import Archive, Listener
from service.adapters.pacs.dimse_client import DimseArchive
from service.pacs import Tally
from tests.dicom_parts import file_bytes
from tests.pacs_archives import TITLE, FakeArchive
from tests.pacs_parts import Looks, Service, drawn_series, service_with
from tests.waiting import until

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("sockets_of_refused_peers")]


def listening(service: Service, port: int) -> AbstractContextManager[Tally]:
    return service.listening(Listener(port=port, calling_ae_titles=(TITLE,)))


def awaited(service: Service) -> int:
    return service.said.getvalue().count("archive awaited")


def test_images_that_cannot_be_sent_are_not_a_series(tmp_path):
    images, drawing = drawn_series()
    archive = FakeArchive(images, withheld=13)
    service = service_with(tmp_path, archive.settings())
    service.configuration = service.configuration.model_copy(update={"images_awaited_s": 0.3})
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with archive.running():
        found = DimseArchive(archive.settings()).images(images[0].StudyInstanceUID, images[0].SeriesInstanceUID)
        assert (len(found.images), found.failed) == (13, 13)
        with service.working():
            service.until_empty()
    assert service.reasons() == ["13 of the 26 images that the drawing refers to are not in the archive."]
    assert archive.stored == []


def test_images_that_nobody_refers_to_are_not_left_out_either(tmp_path):
    images, drawing = drawn_series()
    references = drawing.ReferencedSeriesSequence[0]
    references.ReferencedInstanceSequence = list(references.ReferencedInstanceSequence)[:20]
    archive = FakeArchive(images, withheld=2)
    service = service_with(tmp_path, archive.settings())
    service.configuration = service.configuration.model_copy(update={"images_awaited_s": 0.3})
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with archive.running(), service.working():
        service.until_empty()
    assert service.reasons() == ["2 images of the series that the drawing refers to could not be sent by the archive."]


def test_the_time_for_images_does_not_run_while_the_archive_is_away(tmp_path):
    images, drawing = drawn_series()
    archive, looks = FakeArchive([]), Looks()
    service = service_with(tmp_path, archive.settings())
    service.open_archive = looks.open
    service.configuration = service.configuration.model_copy(update={"images_awaited_s": 2.0})
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with service.working():
        until(lambda: awaited(service) >= 7)  # 0.1 + 0.2 + 0.4 + 0.5 + 0.5 + 0.5 s
        with archive.running():
            until(lambda: looks.count >= 2)
            archive.images = images
            service.until_empty()
    assert len(archive.stored) == len(RESULTS)


@pytest.mark.parametrize("status", [401, 403])
def test_expired_credentials_lose_no_drawing(status, tmp_path):
    class Refusing(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(status)
            self.end_headers()

        def log_message(self, *_):
            pass

    _, drawing = drawn_series()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        archive = Archive(name="archive", dicomweb=f"http://127.0.0.1:{server.server_port}/dicom-web")
        service = service_with(tmp_path, archive)
        service.inbox.receive(file_bytes(drawing), "VIEWER")
        with service.working():
            until(lambda: awaited(service) >= 3)
        server.shutdown()
    assert service.inbox.backlog() == 1
    assert service.inbox.quarantined() == 0
    assert "does not accept the credentials" in service.said.getvalue()


@pytest.mark.parametrize("lost", ["authorization_file", "authorities"])
def test_a_file_that_is_being_renewed_loses_no_drawing(lost, tmp_path):
    _, drawing = drawn_series()
    (port,) = free_ports(1)
    gone = {lost: tmp_path / "gone"}
    service = service_with(tmp_path, Archive(name="archive", dicomweb=f"https://127.0.0.1:{port}/dicom-web", **gone))
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with service.working():
        until(lambda: awaited(service) >= 2)
    assert service.inbox.quarantined() == 0


def test_a_drawing_whose_job_was_cancelled_is_taken_anew(tmp_path):
    images, drawing = drawn_series()
    archive = FakeArchive(images)
    service = service_with(tmp_path, archive.settings())
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    (key,) = {key.split("/")[2] for key in service.blobs.list("dicom/inbox/")}
    service.jobs.cancel(key)
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    assert service.inbox.backlog() == 1
    with archive.running(), service.working():
        service.until_empty()
    assert len(archive.stored) == len(RESULTS)


def test_an_archive_may_commit_itself_late(tmp_path):
    images, drawing = drawn_series()
    archive, (port,) = FakeArchive(images), free_ports(1)
    service = service_with(tmp_path, archive.settings(commitment=True))
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with archive.running(), listening(service, port):
        with service.working():
            until(archive.asked.is_set)
            until(lambda: awaited(service) >= 3)
        with service.working():  # another process
            until(lambda: awaited(service) >= 5)
            ((transaction, asked),) = archive.requests
            assert archive.stored == asked
            assert len(set(asked)) == len(RESULTS)
            assert service.inbox.backlog() == 1
            assert archive.report(port, transaction, asked) == 0
            service.until_empty()
    assert len(archive.requests) == 1
    assert len(archive.stored) == len(RESULTS)
    assert list(service.blobs.list(f"{COMMITMENTS}/")) == []


def test_what_an_archive_lost_is_stored_again_and_asked_for_anew(tmp_path):
    images, drawing = drawn_series()
    archive, (port,) = FakeArchive(images), free_ports(1)
    service = service_with(tmp_path, archive.settings(commitment=True))
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with archive.running(), listening(service, port), service.working():
        until(archive.asked.is_set)
        first, asked = archive.requests[0]
        archive.report(port, first, asked[2:], failed=asked[:2])
        until(lambda: len(archive.requests) == 2)
        second, again = archive.requests[1]
        assert second != first
        assert again == asked
        assert archive.stored == asked + asked[:2]
        archive.report(port, second, asked)
        service.until_empty()
    assert len(archive.requests) == 2


def test_a_silent_archive_is_asked_again_and_may_answer_either_time(tmp_path):
    images, drawing = drawn_series()
    archive, (port,) = FakeArchive(images), free_ports(1)
    service = service_with(tmp_path, archive.settings(commitment=True, commitment_awaited_s=1.0))
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with archive.running(), listening(service, port), service.working():
        until(lambda: len(archive.requests) == 2)
        (first, asked), (second, _) = archive.requests
        assert first != second
        assert archive.stored == asked  # it shows them, so they are not sent again
        archive.report(port, first, asked)
        service.until_empty()
    assert list(service.blobs.list(f"{COMMITMENTS}/")) == []


def test_reports_that_nobody_awaits_are_not_kept(tmp_path):
    archive, (port,) = FakeArchive([]), free_ports(1)
    service = service_with(tmp_path, archive.settings())
    with listening(service, port):
        assert archive.report(port, "1.2.3", ["1.2.3.4"]) == 0
    assert list(service.blobs.list(f"{COMMITMENTS}/")) == []
