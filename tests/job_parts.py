"""What tests of jobs share: a worker in this process over the same models and folders as a service."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
from fastapi import FastAPI

from service.adapters.jobs.worker import running_worker
from service.jobs.kinds import all_kinds
from service.jobs.worker import make_tools, worker_options
from service.observability import make_log


@contextmanager
def working(app: FastAPI, slot: int = 0) -> Iterator[None]:
    """A worker of the jobs of an application."""
    services = app.state.services
    tools = make_tools(services.settings, services.registry, services.log)
    with running_worker(all_kinds(tools), worker_options(services.settings, slot), make_log("error")):
        yield


def ended(client: httpx.Client, place: str, limit_s: float = 120.0) -> dict:
    """The summary of a job once it has ended."""
    limit = time.monotonic() + limit_s
    while (summary := client.get(place).raise_for_status().json())["state"] in ("queued", "running"):
        assert time.monotonic() < limit, summary
        time.sleep(0.1)
    return summary
