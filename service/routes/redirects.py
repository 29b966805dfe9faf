"""Redirections that stay with the server that the client found, however it names it."""

from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send


class RelativeRedirects:
    """Makes the router's redirections, from addresses with a slash too many or too few, relative.

    The router takes scheme and host from the request: behind a proxy that ends TLS they are others than the client's,
    and who makes up a Host header would be sent there.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass one request on."""

        async def relative(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] == 307:
                headers = MutableHeaders(raw=message["headers"])
                place = urlsplit(headers["location"])
                headers["location"] = f"/{place.path.lstrip('/')}{'?' if place.query else ''}{place.query}"
            await send(message)

        await self._app(scope, receive, relative)
