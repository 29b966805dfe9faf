"""The one kind of body that requests have, read as a whole or refused."""

from fastapi import Request
from python_multipart.multipart import parse_options_header
from starlette.datastructures import FormData
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import Message

from model.errors import TooLarge
from service.errors import Abandoned, StoreFull, UnsupportedMediaType
from service.full_disks import is_full
from service.routes.problems import MalformedBody

MEDIA_TYPE = b"multipart/form-data"
#: Fields of a body that are no files, at most.
MOST_FIELDS = 64
#: How the reader of forms begins to say that there are more files than it was told to take.
TOO_MANY_FILES = "Too many files"
CUT_OFF = (
    "The request's body is cut off: the boundary that closes multipart/form-data (--BOUNDARY--) is missing; send the "
    "whole body."
)


def with_whole_body(request: Request) -> Request:
    """The same request, whose body has to be whole.

    Raises:
        UnsupportedMediaType: the body is of another kind, or compressed.
        MalformedBody: while the body is read, when it ends before its last boundary.
    """
    require_plain(request)
    media, options = parse_options_header(request.headers.get("content-type", ""))
    if media != MEDIA_TYPE:
        raise UnsupportedMediaType("The request's body must be multipart/form-data; the interface names its parts.")
    boundary = options.get(b"boundary")
    return request if boundary is None else Request(request.scope, _Whole(request, boundary).receive)


def require_plain(request: Request) -> None:
    """Refuse a body that is compressed as a whole: `UnsupportedMediaType`."""
    if request.headers.get("content-encoding", "identity").strip().lower() not in ("", "identity"):
        raise UnsupportedMediaType("The request's body must be sent as it is, without the header Content-Encoding.")


async def read_form(request: Request, most_files: int) -> FormData:
    """The parts of a body; the request keeps them for whoever asks again.

    Parts are held in memory up to a megabyte each, so many small ones are refused while they arrive.

    Args:
        most_files: that any request may hold.

    Raises:
        TooLarge: more files.
        Abandoned: the client went away first.
        StoreFull: the disk of temporary files has no room for the body.
    """
    try:
        return await request.form(max_files=most_files + 1, max_fields=MOST_FIELDS)
    except HTTPException as fault:
        if str(fault.detail).startswith(TOO_MANY_FILES):
            raise TooLarge(
                f"At most {most_files} files are accepted, each in a part named mask.", part="mask"
            ) from fault
        raise
    except ClientDisconnect:
        raise Abandoned("The client went away before its request was read.") from None
    except OSError as fault:
        if is_full(fault):
            raise StoreFull("The disk has no room for what was sent; send the request again later.") from fault
        raise


class _Whole:
    """Messages of a body, which must hold the boundary that closes it (RFC 2046, 5.1.1).

    The reader of forms takes what it has when a body ends early, so that a request without its last parts would look
    like one that never had them.
    """

    def __init__(self, request: Request, boundary: bytes) -> None:
        self._receive = request.receive
        self._closing = b"\r\n--" + boundary + b"--"
        self._last = b"\r\n"
        self._closed = False

    async def receive(self) -> Message:
        message = await self._receive()
        if message["type"] == "http.request" and not self._closed:
            seen = self._last + message.get("body", b"")
            self._closed = self._closing in seen
            self._last = seen[1 - len(self._closing) :]
            if not self._closed and not message.get("more_body", False):
                raise MalformedBody(CUT_OFF)
        return message
