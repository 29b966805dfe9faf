"""Objects that are sent with STOW-RS: each whole, in little memory, and only as they are sent."""

import asyncio
import tempfile
from contextlib import ExitStack

import pytest
from fastapi import Request

from model.errors import TooLarge
from service.errors import StoreFull, UnsupportedMediaType
from service.routes.stow import IN_MEMORY, MOST_OBJECTS, boundary_of, parts_of
from tests.small_disks import small_disk

KIND = b'multipart/related; type="application/dicom"; boundary=b'
OBJECTS = [b"1", bytes(range(256)) * 12_000, b"", b"--b"]


def body_of(objects):
    head = b"--b\r\nContent-Type: application/dicom\r\n\r\n"
    return b"".join(head + one + b"\r\n" for one in objects) + b"--b--\r\n"


def request_of(body=b"", piece=70_000, **headers):
    pieces = [body[start : start + piece] for start in range(0, len(body), piece)]
    messages = iter(
        {"type": "http.request", "body": data, "more_body": number + 1 < len(pieces)}
        for number, data in enumerate(pieces)
    )

    async def receive():
        return next(messages)

    named = {"content-type": KIND, **{name.replace("_", "-"): value for name, value in headers.items()}}
    return Request({"type": "http", "headers": [(name.encode(), value) for name, value in named.items()]}, receive)


def parts_in(kept, body):
    return asyncio.run(parts_of(request_of(body), b"b", kept))


def test_parts_are_what_was_sent_and_long_ones_lie_on_the_disk():
    with ExitStack() as kept:
        parts = parts_in(kept, body_of(OBJECTS))
        lengths = [part.seek(0, 2) for part in parts]
        assert [part._rolled for part in parts] == [length > IN_MEMORY for length in lengths]
        for part, sent in zip(parts, OBJECTS, strict=True):
            part.seek(0)
            assert part.read() == sent
    assert all(part.closed for part in parts)


@pytest.mark.parametrize("cut", [1, 10, 2_000_000])
def test_a_body_that_is_cut_off_is_refused(cut):
    with ExitStack() as kept, pytest.raises(UnsupportedMediaType):
        parts_in(kept, body_of(OBJECTS)[: -4 - cut])


def test_a_body_that_finds_no_room_is_for_later_and_leaves_nothing(tmp_path, monkeypatch):
    with small_disk(tmp_path / "temporary", "2m") as temporary:
        monkeypatch.setattr(tempfile, "tempdir", str(temporary))
        with ExitStack() as kept, pytest.raises(StoreFull):
            parts_in(kept, body_of(OBJECTS))
        assert list(temporary.iterdir()) == []


def test_a_compressed_body_is_refused():
    assert boundary_of(request_of()) == b"b"
    with pytest.raises(UnsupportedMediaType, match="Content-Encoding"):
        boundary_of(request_of(content_encoding=b"gzip"))


def test_more_objects_than_a_request_may_hold_are_refused_before_they_are_kept():
    with ExitStack() as kept:
        assert len(parts_in(kept, body_of([b"1"] * MOST_OBJECTS))) == MOST_OBJECTS
    with ExitStack() as kept, pytest.raises(TooLarge, match=str(MOST_OBJECTS)):
        parts_in(kept, body_of([b""] * (MOST_OBJECTS + 1)))
