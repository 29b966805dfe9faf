"""Around every request: its identifier, its log entry and figures, its key, and the size of its body."""

import hashlib
import hmac
import re
import time
import uuid
from collections.abc import Sequence

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from model.errors import MorphoFlowError, TooLarge
from service.errors import Unauthorised
from service.observability import Log, Metrics
from service.routes.problems import internal_error, respond_to

_SAFE_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}\Z")
#: Open without a key: probes, the page, which asks for one, and the description of the interface.
OPEN_PATHS = ("/", "/healthz", "/readyz", "/docs", "/openapi.json")
OPEN_PREFIXES = ("/static-offline-docs/", "/page/")


class AccessMiddleware:
    """Outermost: identifies, times, counts and logs requests, and turns faults into a bare 500."""

    def __init__(self, app: ASGIApp, *, log: Log, metrics: Metrics) -> None:
        self._app = app
        self._log = log
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on and record what became of it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request_id = _request_id(Headers(scope=scope).get("x-request-id"))
        scope.setdefault("state", {})["request_id"] = request_id
        answer = _Answer(send, request_id)
        began = time.perf_counter()
        try:
            await self._app(scope, receive, answer.send)
        except Exception as fault:
            answer.status = answer.status or 500
            self._log.error("fault", request_id=request_id, route=_route(scope), exc_info=fault)
            if answer.started:
                raise
            await internal_error(request_id)(scope, receive, answer.send)
        finally:
            self._record(scope, answer.status, time.perf_counter() - began, request_id)

    def _record(self, scope: Scope, status: int, duration_s: float, request_id: str) -> None:
        route, method = _route(scope), _method(scope)
        self._metrics.requests.labels(method, route, str(status)).inc()
        self._metrics.latency.labels(route).observe(duration_s)
        entry = {"method": method, "route": route, "status": status, "duration_s": round(duration_s, 4)}
        self._log.info("request", request_id=request_id, **entry)


class _Answer:
    def __init__(self, send: Send, request_id: str) -> None:
        self._send = send
        self._request_id = request_id
        self.status = 0
        self.started = False

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.started, self.status = True, message["status"]
            headers = MutableHeaders(scope=message)
            headers["X-Request-ID"] = self._request_id
            headers["X-Content-Type-Options"] = "nosniff"
            headers.setdefault("Cache-Control", "no-store")
        await self._send(message)


class KeyMiddleware:
    """Asks for a key when there is one; compares in constant time."""

    def __init__(self, app: ASGIApp, *, keys: Sequence[str]) -> None:
        self._app = app
        self._keys = [key.encode() for key in keys]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on if it carries a key or needs none."""
        if scope["type"] == "http" and self._keys and not _is_open(scope):
            key = self._accepted(Headers(scope=scope))
            if key is None:
                error = Unauthorised("Send a valid key in the header X-API-Key or as Authorization: Bearer.")
                await _refuse(error, scope, receive, send)
                return
            scope["state"]["client"] = hashlib.sha256(key).hexdigest()
        await self._app(scope, receive, send)

    def _accepted(self, headers: Headers) -> bytes | None:
        scheme, _, token = headers.get("authorization", "").partition(" ")
        offered = [headers.get("x-api-key", ""), token.strip() if scheme.lower() == "bearer" else ""]
        matches = [key for given in offered for key in self._keys if hmac.compare_digest(given.encode("latin-1"), key)]
        return matches[0] if matches else None


class BodyLimitMiddleware:
    """Refuses a body over the limit: at once by its declared length, else when it grows past it."""

    def __init__(self, app: ASGIApp, *, max_bytes: int) -> None:
        self._app = app
        self._max_bytes = max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on with its body counted."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        declared = Headers(scope=scope).get("content-length", "0")
        if declared.isdecimal() and int(declared) > self._max_bytes:
            await _refuse(self._too_large(), scope, receive, send)
            return
        body = _Body(receive, send, self._max_bytes, self._too_large())
        await self._app(scope, body.receive, body.send)

    def _too_large(self) -> TooLarge:
        return TooLarge(f"The request's body must not be larger than {self._max_bytes} bytes.", part="body")


class _Body:
    def __init__(self, receive: Receive, send: Send, max_bytes: int, error: TooLarge) -> None:
        self._receive = receive
        self._send = send
        self._left = max_bytes
        self._error = error

    async def receive(self) -> Message:
        message = await self._receive()
        self._left -= len(message.get("body", b""))
        if self._left < 0:
            raise self._error
        return message

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start" and self._left < 0:
            MutableHeaders(scope=message)["Connection"] = "close"  # else the server reads the rest
        await self._send(message)


class HeadMiddleware:
    """Innermost: answers HEAD with the headers of GET and no body (RFC 9110, 9.1 and 9.3.2)."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on; work for a body ends where the body would begin."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return
        asked = {**scope, "method": "GET"}

        async def head(message: Message) -> None:
            if message["type"] == "http.response.body":
                await send({"type": "http.response.body", "body": b"", "more_body": False})
                raise _HeadSent
            await send(message)

        try:
            await self._app(asked, receive, head)
        except _HeadSent:
            pass
        finally:
            scope["route"] = asked.get("route")


class _HeadSent(Exception):
    """The whole answer to HEAD is sent."""


async def _refuse(error: MorphoFlowError, scope: Scope, receive: Receive, send: Send) -> None:
    response = respond_to(error, request_id=scope["state"]["request_id"], retry_after_s=0)
    response.headers["Connection"] = "close"
    await response(scope, receive, send)


def _request_id(given: str | None) -> str:
    return given if given and _SAFE_REQUEST_ID.match(given) else uuid.uuid4().hex


def _is_open(scope: Scope) -> bool:
    path = scope["path"].removeprefix(scope.get("root_path", ""))
    return path in OPEN_PATHS or path.startswith(OPEN_PREFIXES)


def _route(scope: Scope) -> str:
    return getattr(scope.get("route"), "path", None) or "unmatched"


def _method(scope: Scope) -> str:
    return scope["method"] if scope["method"] in _METHODS else "other"


_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
