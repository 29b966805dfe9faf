"""Storage that refuses is a failure of the medium, whatever the library calls it, and told without places."""

import base64
import hashlib
import io
import re
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

import pytest

pytest.importorskip("boto3")

from model.errors import InvalidParameter
from service.adapters.blob_results import BlobResultStore
from service.adapters.s3 import S3Blobs
from service.errors import Cancelled, StoreFull
from tests.service_parts import outcome_of

PAGE = 1000
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


class Keeping(BaseHTTPRequestHandler):
    """Lists and removes objects a page at a time, and only with the sum that servers of any age know."""

    protocol_version = "HTTP/1.1"

    def do_GET(self):
        asked = parse_qs(urlsplit(self.path).query)
        after = asked.get("continuation-token", [""])[0]
        left = sorted(key for key in self.server.keys if key > after and key.startswith(asked["prefix"][0]))
        more = f"<NextContinuationToken>{left[PAGE - 1]}</NextContinuationToken>" if len(left) > PAGE else ""
        keys = "".join(f"<Contents><Key>{key}</Key></Contents>" for key in left[:PAGE])
        truncated = f"<IsTruncated>{str(bool(more)).lower()}</IsTruncated>"
        self._answer(200, f"<ListBucketResult>{keys}{truncated}{more}</ListBucketResult>")

    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        asked = re.findall("<Key>(.*?)</Key>", body.decode())
        digest = base64.b64encode(hashlib.md5(body, usedforsecurity=False).digest()).decode()
        if self.headers["Content-MD5"] != digest or "x-amz-checksum-crc32" in self.headers or len(asked) > PAGE:
            self._answer(400, "<Error><Code>InvalidRequest</Code></Error>")
            return
        faults = [(key, self.server.faults[key]) for key in asked if key in self.server.faults]
        self.server.keys -= set(asked) - self.server.faults.keys()
        told = "".join(f"<Error><Key>{key}</Key><Code>{code}</Code></Error>" for key, code in faults)
        self._answer(200, f"<DeleteResult>{told}</DeleteResult>")

    def do_DELETE(self):
        self.server.keys.discard(urlsplit(self.path).path.removeprefix("/bucket/"))
        self._answer(204, "")

    def _answer(self, status, text):
        self.server.asked.append(self.command)
        self.send_response(status)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        self.wfile.write(text.encode())

    def log_message(self, *_):
        """Keep quiet."""


@contextmanager
def serving(handler):
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        server.asked = []
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


@pytest.fixture
def keys(monkeypatch):
    for name, value in (("ACCESS_KEY_ID", "a"), ("SECRET_ACCESS_KEY", "b"), ("DEFAULT_REGION", "us-east-1")):
        monkeypatch.setenv(f"AWS_{name}", value)


@pytest.fixture
def server(keys):  # noqa: ARG001
    with serving(Refusing) as server:
        yield server


@pytest.fixture
def bucket(keys):  # noqa: ARG001
    with serving(Keeping) as server:
        server.keys = {f"prefix/jobs/a/{number:08d}" for number in range(2 * PAGE + 500)} | {"prefix/jobs/b/0"}
        server.faults = {}
        yield server


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


def test_a_folder_is_removed_a_page_of_objects_at_a_request(bucket):
    opened(bucket).delete("jobs/a/")
    assert bucket.keys == {"prefix/jobs/b/0"}
    assert bucket.asked == ["GET", "POST"] * 3


def test_a_folder_with_nothing_in_it_is_removed_without_a_request_to_do_so(bucket):
    opened(bucket).delete("jobs/c/")
    assert bucket.asked == ["GET"]


def test_an_object_that_stays_is_a_failure_though_the_request_succeeds(bucket):
    bucket.faults = {"prefix/jobs/a/00000003": "AccessDenied"}
    with pytest.raises(OSError, match="object storage refused") as caught:
        opened(bucket).delete("jobs/a/")
    assert "00000003" not in str(caught.value)
    assert "prefix/jobs/a/00000003" in bucket.keys


def test_an_object_that_was_removed_meanwhile_is_none(bucket):
    bucket.faults = {"prefix/jobs/a/00000003": "NoSuchKey"}
    opened(bucket).delete("jobs/a/")
    assert bucket.keys == {"prefix/jobs/a/00000003", "prefix/jobs/b/0"}


def test_removal_ends_between_pages_and_is_gone_on_with_later(bucket):
    turns = []

    def check():
        turns.append(1)
        if len(turns) == 2:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        opened(bucket).delete("jobs/a/", check)
    assert len(bucket.keys) == PAGE + 501
    opened(bucket).delete("jobs/a/", check)
    assert bucket.keys == {"prefix/jobs/b/0"}
