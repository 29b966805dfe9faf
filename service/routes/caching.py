"""Answers that are pure functions of a model's digest and the query: tagged, and cacheable for ever (RFC 8246).

An address without a version names the newest model of its name, and so another one some day. Whether an answer at such
an address may be kept unasked is the route's choice; where it may not, its tag confirms the copy that a client holds.
"""

import hashlib
from collections.abc import Mapping
from typing import Any

from fastapi import Request
from pydantic import BaseModel
from starlette.responses import Response

from model.bundle import ShapeModel
from service.model_registry import AT
from service.routes.dependencies import Services
from service.routes.negotiation import ANY, etags_of, listed
from service.routes.responses import Responses

#: What depends on the model's digest and the query alone may be kept for ever.
IMMUTABLE = "max-age=31536000, immutable"
#: What may be kept, and has to be confirmed before it is used again.
CONFIRM = "no-cache"
#: Description of the header of a conditional request (RFC 9110, 13.1.2). It is read as it comes, never refused.
CONDITIONAL: dict[str, Any] = {
    "parameters": [
        {
            "name": "If-None-Match",
            "in": "header",
            "required": False,
            "schema": {"type": "string"},
            "description": "tags of copies that the client holds; 304 when one of them is the answer's",
        }
    ]
}
#: Rises when the program gives another answer to the same query of the same model.
REVISION = 2


def names_version(request: Request) -> bool:
    """Whether the path names its model with a version, and so the same one for ever."""
    return AT in str(request.path_params["model"])


def caching_headers(services: Services, model: ShapeModel, kind: str, *query: object, lasting: bool) -> dict[str, str]:
    """A strong tag of model, kind of answer and query, and for how long the answer may be kept, and by whom.

    Args:
        lasting: the answer may be kept for ever; otherwise it has to be confirmed before it is used again.
    """
    values = [part.model_dump_json() if isinstance(part, BaseModel) else repr(part) for part in query]
    text = repr((REVISION, model.digest, kind, *values))
    keeper = "private" if services.settings.keys else "public"
    tag = f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'
    return {"ETag": tag, "Cache-Control": f"{keeper}, {IMMUTABLE if lasting else CONFIRM}"}


def is_held(request: Request, headers: Mapping[str, str]) -> bool:
    """Whether the client names the tag of these headers; that there is such an answer, it knows then."""
    return headers["ETag"] in etags_of(listed(request.headers, "if-none-match"))


def confirmed(request: Request, response: Response) -> Response:
    """The response, or only that there is one where the client has any (``If-None-Match: *``)."""
    if ANY not in etags_of(listed(request.headers, "if-none-match")):
        return response
    return not_modified({name: response.headers[name] for name in ("ETag", "Cache-Control")})


def not_modified(headers: Mapping[str, str]) -> Response:
    """The answer to a client that holds it already."""
    return Response(status_code=304, headers=dict(headers))


def cached(answer: dict[str, Any], *, lasting: bool) -> Responses:
    """Description of an answer with these headers; not `lasting` where the address has to name a version for that."""
    how = f"`{IMMUTABLE}`" if lasting else f"`{IMMUTABLE}` where the address names a version, else `{CONFIRM}`"
    headers = {
        "ETag": {"schema": {"type": "string"}, "description": "strong, of model and query"},
        "Cache-Control": {
            "schema": {"type": "string"},
            "description": f"{how}, and `public`, or `private` where keys are asked for",
        },
    }
    return {
        200: {**answer, "headers": headers},
        304: {"description": "the client holds it already", "headers": headers},
    }
