"""Errors as ``application/problem+json`` (RFC 9457): one shape for everything that goes wrong."""

import re
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, Response
from starlette.routing import Match, Mount

from model.errors import (
    InputError,
    InvalidParameter,
    MorphoFlowError,
    NotFound,
    TooLarge,
    UnknownMode,
    UnknownModel,
)
from service.errors import (
    PROTOCOL_KINDS,
    HelperLost,
    Kind,
    NotReady,
    Overloaded,
    Unauthorised,
    UnknownJob,
    UnknownResult,
    kind_of,
)
from service.schemas import Problem

#: What the reader of multipart bodies says of one beyond its own limits.
_TOO_MANY = re.compile(r"Too many (files|fields)\. Maximum number of \w+ is (\d+)\.")
_TOO_LONG = re.compile(r"(?:Part|Field) exceeded maximum size of (\d+)KB\.")
PROBLEM_MEDIA_TYPE = "application/problem+json"
#: Parts of an address that name what is not here, by the error.
NAMES: dict[type[NotFound], tuple[str, ...]] = {
    UnknownModel: ("model",),
    UnknownMode: ("rank", "mode"),
    UnknownResult: ("id",),
    UnknownJob: ("id",),
}
#: Methods that a route may take; HEAD goes with GET.
METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
#: Sentences for what the HTTP layer finds by itself; its own may repeat what the client sent.
PROTOCOL_SENTENCES = {
    400: "The request's body cannot be parsed: Content-Type must name a boundary, the body must begin with it on a "
    "line of its own, and the headers of each part must be short and name the part.",
    404: "Nothing stands at this address; the interface is described at /docs.",
    405: "The method is not allowed here; the header Allow names those that are.",
    500: "The service met a fault of its own; its logs hold more under the request id.",
}


class MalformedBody(HTTPException):
    """A body that cannot be read, and a sentence that may be told."""

    def __init__(self, sentence: str) -> None:
        super().__init__(400, sentence)


class NamedNotFound(HTTPException):
    """What a parameter names is not here; a problem of the error's kind that names the parameter."""

    def __init__(self, error: NotFound, part: str) -> None:
        super().__init__(404)
        self.error = error
        self.part = part


def problem_response(
    kind: Kind,
    detail: str,
    *,
    request_id: str | None,
    part: str | None = None,
    headers: dict[str, str] | None = None,
    cause: Kind | None = None,
) -> Response:
    """A problem as a response; `cause` is the kind of problem that a job failed of."""
    problem = Problem(
        type=kind.type,
        title=kind.title,
        status=kind.status,
        detail=detail,
        part=part,
        request_id=request_id,
        problem_type=None if cause is None else cause.type,
        problem_status=None if cause is None else cause.status,
    )
    content = problem.model_dump(exclude_none=True)
    return JSONResponse(content, kind.status, headers=headers, media_type=PROBLEM_MEDIA_TYPE)


def respond_to(
    error: MorphoFlowError, *, request_id: str | None, retry_after_s: int, part: str | None = None
) -> Response:
    """The response to one of the project's own errors."""
    kind = kind_of(error)
    detail = str(error) if kind.status != 500 else PROTOCOL_SENTENCES[500]
    part = error.part if isinstance(error, InputError) else part
    cause = error.cause if isinstance(error, NotReady) else None
    headers = _headers(error, retry_after_s)
    return problem_response(kind, detail, request_id=request_id, part=part, headers=headers, cause=cause)


def install_handlers(app: FastAPI, retry_after_s: int) -> None:
    """Answer every error with a problem; faults of the service's own go on to the outermost layer."""

    async def domain(request: Request, error: Exception) -> Response:
        if not isinstance(error, MorphoFlowError) or kind_of(error).status == 500:
            raise error
        part = _name_of(error, request)
        return respond_to(error, request_id=request_id_of(request), retry_after_s=retry_after_s, part=part)

    async def protocol(request: Request, error: Exception) -> Response:
        if isinstance(error.__cause__, MorphoFlowError):
            return await domain(request, error.__cause__)
        return _protocol(request, error)

    app.add_exception_handler(MorphoFlowError, domain)
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(HTTPException, protocol)


def _name_of(error: MorphoFlowError, request: Request) -> str | None:
    """The part of the address that names what is not here: one of its path, else the last that may."""
    names = next((names for kind, names in NAMES.items() if isinstance(error, kind)), ())
    return next((name for name in names if name in request.path_params), names[-1] if names else None)


def request_id_of(request: Request) -> str | None:
    """The identifier under which the logs know a request."""
    identifier: str | None = request.scope.get("state", {}).get("request_id")
    return identifier


def internal_error(request_id: str) -> Response:
    """The response to a fault, with nothing of it but the identifier in the logs."""
    return problem_response(PROTOCOL_KINDS[500], PROTOCOL_SENTENCES[500], request_id=request_id)


def _protocol(request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        raise error
    if isinstance(error, NamedNotFound):
        return respond_to(error.error, request_id=request_id_of(request), retry_after_s=0, part=error.part)
    limit = _multipart_limit(error.detail) if error.status_code == 400 else None
    if limit is not None:
        return respond_to(limit, request_id=request_id_of(request), retry_after_s=0)
    kind = PROTOCOL_KINDS.get(error.status_code, PROTOCOL_KINDS[400])
    headers = dict(error.headers) if error.headers else {}
    if kind.status == 405:
        headers["Allow"] = ", ".join(allowed_methods(request))
    sentence = error.detail if isinstance(error, MalformedBody) else PROTOCOL_SENTENCES[kind.status]
    return problem_response(kind, sentence, request_id=request_id_of(request), headers=headers)


def _multipart_limit(said: str) -> TooLarge | None:
    """What is too large of a body that the reader of multipart bodies gave up."""
    if found := _TOO_MANY.match(said):
        kind, count = ("files" if found[1] == "files" else "parts that are no file"), found[2]
        return TooLarge(f"The request's body must not hold more than {count} {kind}.", part="body")
    if found := _TOO_LONG.match(said):
        return TooLarge(f"A part that is no file must not be larger than {found[1]} KiB.", part="body")
    return None


def allowed_methods(request: Request) -> list[str]:
    """Methods of all routes at the path of a request; whatever answers GET answers HEAD."""
    # Folders of files take GET alone.
    routes = [route for route in request.app.routes if not isinstance(route, Mount)]
    asked = [{**request.scope, "method": method} for method in METHODS]
    found = {one["method"] for one in asked if any(route.matches(one)[0] is Match.FULL for route in routes)} or {"GET"}
    return sorted(found | {"HEAD"} if "GET" in found else found)


async def _invalid(request: Request, error: Exception) -> Response:
    if not isinstance(error, RequestValidationError):
        raise error
    first = error.errors()[0]
    part, sentence = _sentence(first)
    return problem_response(
        kind_of(InvalidParameter("", part=part)), sentence, request_id=request_id_of(request), part=part
    )


def _sentence(fault: dict[str, Any]) -> tuple[str, str]:
    names = [str(item) for item in fault["loc"][1:]] or ["body"]
    part = names[0] if len(names) == 1 else f"{names[0]}[{names[1]}]"
    match fault["type"]:
        case "missing":
            return part, f"The parameter {part} is missing."
        case "value_error" if "UploadFile" in fault["msg"]:
            return (
                part,
                f"The part {part} must be a file, sent with filename=; with curl: -F {names[0]}=@FILE.",
            )
        case _ if isinstance(fault.get("input"), UploadFile):
            return part, f"The part {part} must be text, no file; with curl: -F {names[0]}=VALUE."
        case _:
            reason = str(fault["msg"]).removeprefix("Value error, ")
            return part, f"The parameter {part} is not valid: {reason[:1].lower()}{reason[1:]}."


def _headers(error: MorphoFlowError, retry_after_s: int) -> dict[str, str] | None:
    if isinstance(error, Overloaded | HelperLost):
        return {"Retry-After": str(retry_after_s)}
    if isinstance(error, Unauthorised):
        return {"WWW-Authenticate": 'Bearer realm="morphoflow"'}
    return None
