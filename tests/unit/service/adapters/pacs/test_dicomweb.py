"""What an archive behind DICOMweb answers to objects that it is sent."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from service.adapters.pacs.configuration import Archive
from service.adapters.pacs.dicomweb import DicomWebArchive
from service.errors import ArchiveRefused, ArchiveUnavailable
from tests.dicom_parts import mr_series

OBJECTS = mr_series((8, 8, 2))


@contextmanager
def answering(status: int, body: bytes) -> Iterator[DicomWebArchive]:
    class Answer(BaseHTTPRequestHandler):
        def do_POST(self):
            chunked = self.headers.get("Transfer-Encoding") == "chunked"
            assert not chunked
            self.rfile.read(int(self.headers["Content-Length"]))
            self.send_response(status)
            self.send_header("Content-Type", "application/dicom+json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Answer) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        archive = DicomWebArchive(Archive(name="a", dicomweb=f"http://127.0.0.1:{server.server_port}/dicom-web"))
        yield archive
        archive.close()
        server.shutdown()


def failed(*reasons: int) -> bytes:
    items = [{"00081197": {"vr": "US", "Value": [reason]}} for reason in reasons]
    return json.dumps({"00081198": {"vr": "SQ", "Value": items}}).encode()


@pytest.mark.parametrize("status", [202, 409])
@pytest.mark.parametrize("reasons", [(0x0111,), (0xB00E, 0x0111)])
def test_what_is_there_already_is_stored(status, reasons):
    with answering(status, failed(*reasons)) as archive:
        archive.store(OBJECTS)


@pytest.mark.parametrize("status", [202, 409])
@pytest.mark.parametrize(
    ("reasons", "error", "sentence"),
    [
        ((0x0111, 0xC000), ArchiveRefused, "reason C000"),
        ((0x0122,), ArchiveRefused, "reason 0122"),
        ((0xA701,), ArchiveUnavailable, "no room"),
    ],
)
def test_other_failures_are_told_with_their_reason(status, reasons, error, sentence):
    with answering(status, failed(*reasons)) as archive, pytest.raises(error, match=sentence):
        archive.store(OBJECTS)


@pytest.mark.parametrize("body", [b"", b"no list", b"{}", b"[]", failed()])
def test_a_conflict_without_a_list_is_a_refusal(body):
    with answering(409, body) as archive, pytest.raises(ArchiveRefused, match="status 409"):
        archive.store(OBJECTS)
