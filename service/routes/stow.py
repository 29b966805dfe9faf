"""``POST /dicom-web/studies``: DICOM objects that an archive forwards (STOW-RS; PS3.18, 10.5)."""

from contextlib import ExitStack, suppress
from tempfile import SpooledTemporaryFile
from typing import IO, Annotated, Any

from fastapi import APIRouter, Depends, Request
from fastapi.concurrency import run_in_threadpool
from python_multipart.exceptions import MultipartParseError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.responses import JSONResponse, Response

from model.errors import NotFound, TooLarge
from service.errors import StoreFull, UnsupportedMediaType
from service.full_disks import is_full
from service.pacs_ports import Disposition, ObjectReceiver, Receipt
from service.routes.multipart import require_plain
from service.routes.responses import problems

PATH = "/dicom-web/studies"
MEDIA_TYPE = "application/dicom+json"
#: Who sent what came this way, in rules and in the audit trail.
SENDER = "STOW-RS"
#: Failure reasons of an object (PS3.18, I.2.2): not understood; not kept; not what the request says that it is.
CANNOT_UNDERSTAND, PROCESSING_FAILURE, DOES_NOT_MATCH = 0xC000, 0x0110, 0xA900
#: Objects that one request may hold; each costs a temporary file, a turn of the disk and a line of the audit trail.
MOST_OBJECTS = 10_000
#: Bytes of an object that are in memory while the others are received; the rest is on the disk.
IN_MEMORY = 1 << 20


def receiver_of(request: Request) -> ObjectReceiver:
    """The receiver of objects; `NotFound` where no file says how the service stands among archives."""
    inbox: ObjectReceiver | None = getattr(request.app.state.pacs, "inbox", None)
    if inbox is None:
        raise NotFound("This service takes no DICOM objects; MORPHOFLOW_PACS_FILE is not set.")
    return inbox


def boundary_of(request: Request) -> bytes:
    """What separates the parts; `UnsupportedMediaType` for other bodies."""
    require_plain(request)
    media, options = parse_options_header(request.headers.get("content-type", ""))
    kind = options.get(b"type", b"application/dicom").lower()
    boundary = options.get(b"boundary")
    if media != b"multipart/related" or kind != b"application/dicom" or not boundary:
        raise UnsupportedMediaType(
            'The request\'s body must be multipart/related with type="application/dicom" and a boundary.'
        )
    return boundary


def stow_router() -> APIRouter:
    """Both forms of the route."""
    router = APIRouter(tags=["DICOM"])
    shared: dict[str, Any] = {
        "methods": ["POST"],
        "response_class": Response,
        "openapi_extra": {
            "requestBody": {
                "required": True,
                "content": {'multipart/related; type="application/dicom"': {"schema": {"type": "string"}}},
            }
        },
        "responses": {
            200: {"description": "all were taken", "content": {MEDIA_TYPE: {"schema": {"type": "object"}}}},
            202: {"description": "some were taken", "content": {MEDIA_TYPE: {"schema": {"type": "object"}}}},
            409: {"description": "none was taken", "content": {MEDIA_TYPE: {"schema": {"type": "object"}}}},
            **problems(400, 404, 413, 415, 503, 507),
        },
    }
    router.add_api_route(PATH, store_instances, summary="Take DICOM objects (STOW-RS)", **shared)
    router.add_api_route(PATH + "/{study}", store_study_instances, summary="Take DICOM objects of one study", **shared)
    return router


async def store_instances(
    request: Request,
    receiver: Annotated[ObjectReceiver, Depends(receiver_of)],
    boundary: Annotated[bytes, Depends(boundary_of)],
) -> Response:
    """Keeps each object on disk and in a durable job before it is acknowledged.

    What no rule takes is acknowledged and left alone.
    """
    return await _store(request, receiver, boundary, None)


async def _store(request: Request, receiver: ObjectReceiver, boundary: bytes, study: str | None) -> Response:
    with ExitStack() as kept:
        objects = await parts_of(request, boundary, kept)
        receipts = [await run_in_threadpool(_receive, receiver, found, study) for found in objects]
    taken = [r for r in receipts if r.disposition in (Disposition.ACCEPTED, Disposition.LEFT_ALONE)]
    status = 200 if len(taken) == len(receipts) > 0 else 202 if taken else 409
    return JSONResponse(response_module(receipts), status, media_type=MEDIA_TYPE)


async def store_study_instances(
    request: Request,
    study: str,
    receiver: Annotated[ObjectReceiver, Depends(receiver_of)],
    boundary: Annotated[bytes, Depends(boundary_of)],
) -> Response:
    """As without a study in the path; objects of other studies are refused (failure reason A900)."""
    return await _store(request, receiver, boundary, study)


async def parts_of(request: Request, boundary: bytes, kept: ExitStack) -> list[IO[bytes]]:
    """Bodies of the parts as temporary files, which end with `kept`.

    Raises:
        UnsupportedMediaType: the body is not complete.
        TooLarge: more than `MOST_OBJECTS` parts.
        StoreFull: the disk of temporary files has no room for the body.
    """
    parts: list[IO[bytes]] = []
    ended: list[bool] = []
    callbacks: Any = {
        "on_part_begin": lambda: parts.append(_begun(kept, len(parts))),
        "on_part_data": lambda data, start, end: parts[-1].write(data[start:end]),
        "on_end": lambda: ended.append(True),
    }
    try:
        parser = MultipartParser(boundary, callbacks)
        async for chunk in request.stream():
            await run_in_threadpool(parser.write, chunk)
        parser.finalize()
    except MultipartParseError:
        ended.clear()
    except OSError as fault:
        if is_full(fault):
            raise StoreFull("The disk has no room for what was sent; send the request again later.") from fault
        raise
    if not ended:
        raise UnsupportedMediaType("The request's body must be complete multipart/related with one object a part.")
    return parts


def _begun(kept: ExitStack, earlier: int) -> IO[bytes]:
    if earlier == MOST_OBJECTS:
        raise TooLarge(f"The request's body must not hold more than {MOST_OBJECTS} objects.", part="body")
    file = SpooledTemporaryFile(IN_MEMORY)  # noqa: SIM115 - the stack closes it
    kept.callback(_close, file)
    return file


def _close(file: IO[bytes]) -> None:
    with suppress(OSError):  # a disk without room for what is written at the end
        file.close()


def response_module(receipts: list[Receipt]) -> dict[str, Any]:
    """The store instances response module (PS3.18, table 10.5.3-1) in the DICOM JSON model."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for receipt in receipts:
        item = {
            "00081150": {"vr": "UI", "Value": [receipt.sop_class]},
            "00081155": {"vr": "UI", "Value": [receipt.sop_instance]},
        }
        reason = {
            Disposition.QUARANTINED: CANNOT_UNDERSTAND,
            Disposition.MISPLACED: DOES_NOT_MATCH,
            Disposition.FAILED: PROCESSING_FAILURE,
        }
        failed = reason.get(receipt.disposition)
        if failed is None:
            groups.setdefault("00081199", []).append(item)
        else:
            groups.setdefault("00081198", []).append({**item, "00081197": {"vr": "US", "Value": [failed]}})
    return {tag: {"vr": "SQ", "Value": items} for tag, items in groups.items()}


def _receive(receiver: ObjectReceiver, found: IO[bytes], study: str | None) -> Receipt:
    try:
        found.seek(0)
        return receiver.receive(found.read(), SENDER, study)
    except OSError:
        return Receipt(Disposition.FAILED)
