"""The one kind of body that requests have."""

from fastapi import Request

from service.errors import UnsupportedMediaType


def require_multipart(request: Request) -> None:
    """Refuse other bodies: `UnsupportedMediaType`."""
    media = request.headers.get("content-type", "").split(";")[0].strip().lower()
    if media != "multipart/form-data":
        raise UnsupportedMediaType("The request's body must be multipart/form-data; the interface names its parts.")
