"""Storage that refuses is a failure of the medium, whatever the library calls it, and told without places."""

import io
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

pytest.importorskip("boto3")

from model.errors import InvalidParameter
from service.adapters.blob_results import BlobResultStore
from service.adapters.s3 import S3Blobs
from service.errors import StoreFull
from tests.service_parts import outcome_of

REFUSAL = b"<Error><Code>QuotaExceeded</Code><Message>full</Message></Error>"


class Refusing(BaseHTTPRequestHandler):
    """Takes nothing, and notes who asked."""

    protocol_version = "HTTP/1.1"

    def do_GET(self):
        self.server.asked.append(self.headers["Authorization"])
        self.rfile.read(int(self.headers.get("Content-Length") or 0))
        self.send_response(403)
        self.send_header("Content-Length", str(len(REFUSAL)))
        self.end_headers()
        self.wfile.write(REFUSAL)

    def do_PUT(self):
        self.do_GET()

    def do_POST(self):
        self.do_GET()

    def log_message(self, *_):
        """Keep quiet."""


@pytest.fixture
def server(monkeypatch):
    for name, value in (("ACCESS_KEY_ID", "a"), ("SECRET_ACCESS_KEY", "b"), ("DEFAULT_REGION", "us-east-1")):
        monkeypatch.setenv(f"AWS_{name}", value)
    with ThreadingHTTPServer(("127.0.0.1", 0), Refusing) as server:
        server.asked = []
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


def opened(server):
    return S3Blobs("s3://bucket/prefix", f"http://127.0.0.1:{server.server_port}")


@pytest.fixture
def blobs(server):
    return opened(server)


@pytest.mark.parametrize(
    "call",
    [
        lambda blobs: blobs.put("place", b"1"),
        lambda blobs: blobs.put_file("place", io.BytesIO(b"1")),
        lambda blobs: blobs.put_file("place", io.BytesIO(bytes(9 << 20))),
        lambda blobs: blobs.get("place"),
        lambda blobs: blobs.exists("place"),
        lambda blobs: list(blobs.list("place/")),
        lambda blobs: list(blobs.folders("place/")),
        lambda blobs: blobs.delete("place/"),
    ],
    ids=["bytes", "file", "file in pieces", "get", "exists", "list", "folders", "delete"],
)
def test_a_refusal_is_a_failure_of_the_medium(blobs, call):
    with pytest.raises(OSError, match="object storage refused") as caught:
        call(blobs)
    assert "place" not in str(caught.value)
    assert "bucket" not in str(caught.value)


def test_a_result_that_storage_refuses_is_one_for_later(blobs):
    with pytest.raises(StoreFull):
        BlobResultStore(blobs, lifetime_s=10.0).save(outcome_of())


@pytest.mark.parametrize(("name", "value"), [("AWS_PROFILE", "absent"), ("AWS_DEFAULT_REGION", "no region")])
def test_surroundings_that_no_client_can_be_made_in_are_told_in_a_sentence(blobs, monkeypatch, name, value):  # noqa: ARG001
    monkeypatch.setenv(name, value)
    with pytest.raises(InvalidParameter, match=name) as caught:
        S3Blobs("s3://bucket", None)
    assert value not in str(caught.value)


def test_each_storage_is_asked_with_the_keys_of_its_time(server, monkeypatch):
    for key in ("first", "second"):
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", key)
        with pytest.raises(OSError, match="refused"):
            opened(server).get("place")
        assert f"Credential={key}/" in server.asked[-1]
