"""The HTTP server of the program: it tells others to leave when it begins to, and not when it has left."""

import socket
from collections.abc import Callable

import uvicorn
from fastapi import FastAPI

from service.routes.dependencies import Services

#: An idle connection stays open so long (s): longer than at a load balancer, which would send into a closing one.
KEEP_ALIVE_S = 75
#: Requests that run when the server is told to end have so long (s) to be answered.
DRAIN_S = 30


class Server(uvicorn.Server):
    """Serves an application where its settings say.

    Args:
        leave: tells what stands beside the server that it begins to end.
    """

    def __init__(self, app: FastAPI, leave: Callable[[], None]) -> None:
        services: Services = app.state.services
        super().__init__(_configuration(app, services))
        self._leaving = (services.closing.set, leave)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End streams that have no end of their own, and answer what was begun, for `DRAIN_S` at most."""
        for leave in self._leaving:
            leave()
        await super().shutdown(sockets)


def _configuration(app: FastAPI, services: Services) -> uvicorn.Config:
    settings = services.settings
    return uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        root_path=settings.root_path,
        access_log=False,
        log_config=None,
        server_header=False,
        timeout_graceful_shutdown=DRAIN_S,
        timeout_keep_alive=KEEP_ALIVE_S,
    )
