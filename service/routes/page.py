"""``/``: the page on which shapes are reconstructed, drawn and compared, and the files that it is made of."""

import gzip
import mimetypes
import re
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable

from fastapi import APIRouter, Request
from starlette.exceptions import HTTPException
from starlette.responses import Response

#: Where the files of the page stand, below the service's own address.
ASSETS = "/page"
#: Everything comes from this service alone; pictures are drawn in the browser (blob, data).
POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' blob: data:",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)
_SECURITY = {
    "Content-Security-Policy": POLICY,
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
#: What names of its files are made of.
_NAME = re.compile(r"[A-Za-z0-9_.-]+")
#: The build puts a digest of the content into the name of what may change.
_DIGEST = re.compile(r"-[A-Za-z0-9_-]{8}\.(js|css)$")
_IMMUTABLE, _ASK_AGAIN = "public, max-age=31536000, immutable", "no-cache"


def page_router() -> APIRouter:
    """The routes; they stand in the way of nobody and are no part of the interface's description."""
    router = APIRouter(include_in_schema=False)
    router.add_api_route("/", read_page, methods=["GET", "HEAD"], response_class=Response)
    router.add_api_route(f"{ASSETS}/{{name}}", read_asset, methods=["GET", "HEAD"], response_class=Response)
    return router


def read_page(request: Request) -> Response:
    """The page itself; all its addresses are relative, so that it works behind a prefix."""
    return _file(request, "index.html")


def read_asset(name: str, request: Request) -> Response:
    """A script, a style or the example."""
    if not _NAME.fullmatch(name):
        raise HTTPException(404)
    return _file(request, f"page/{name}")


def _file(request: Request, name: str) -> Response:
    found = _built() / name
    if not found.is_file():
        raise HTTPException(404)
    headers, media_type = {**_SECURITY, "Cache-Control": _ASK_AGAIN}, _media_type(found.name)
    if not _DIGEST.search(name):
        return Response(found.read_bytes(), media_type=media_type, headers=headers)
    headers |= {"Cache-Control": _IMMUTABLE, "Vary": "Accept-Encoding"}
    if "gzip" not in request.headers.get("accept-encoding", ""):
        return Response(found.read_bytes(), media_type=media_type, headers=headers)
    return Response(_compressed(name), media_type=media_type, headers={**headers, "Content-Encoding": "gzip"})


def _built() -> Traversable:
    return files("service") / "page" / "built"


@cache
def _compressed(name: str) -> bytes:
    return gzip.compress((_built() / name).read_bytes(), compresslevel=9, mtime=0)


def _media_type(name: str) -> str:
    known = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".svg": "image/svg+xml"}
    return known.get(name[name.rfind(".") :]) or mimetypes.guess_type(name)[0] or "application/octet-stream"
