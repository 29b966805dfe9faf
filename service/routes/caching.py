"""Answers that never change: pure functions of a model's digest and the query, cacheable for ever (RFC 8246)."""

import hashlib
from collections.abc import Mapping
from typing import Any

from fastapi import Request
from pydantic import BaseModel
from starlette.responses import Response

from model.bundle import ShapeModel
from service.routes.dependencies import Services
from service.routes.negotiation import listed, matches_etag
from service.routes.responses import Responses

#: What depends on the model's digest and the query alone may be kept for ever.
IMMUTABLE = "max-age=31536000, immutable"
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


def caching_headers(services: Services, model: ShapeModel, kind: str, *query: object) -> dict[str, str]:
    """A strong tag of model, kind of answer and query, and for how long the answer may be kept, and by whom."""
    values = [part.model_dump_json() if isinstance(part, BaseModel) else repr(part) for part in query]
    text = repr((REVISION, model.digest, kind, *values))
    keeper = "private" if services.settings.keys else "public"
    return {"ETag": f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"', "Cache-Control": f"{keeper}, {IMMUTABLE}"}


def is_held(request: Request, headers: Mapping[str, str]) -> bool:
    """Whether the client holds the answer of these headers already."""
    return matches_etag(listed(request.headers, "if-none-match"), headers["ETag"])


def not_modified(headers: Mapping[str, str]) -> Response:
    """The answer to a client that holds it already."""
    return Response(status_code=304, headers=dict(headers))


def cached(answer: dict[str, Any]) -> Responses:
    """Description of an answer with these headers."""
    headers = {
        "ETag": {"schema": {"type": "string"}, "description": "strong, of model and query"},
        "Cache-Control": {
            "schema": {"type": "string"},
            "description": f"`{IMMUTABLE}`, and `public`, or `private` where keys are asked for",
        },
    }
    return {
        200: {**answer, "headers": headers},
        304: {"description": "the client holds it already", "headers": headers},
    }
