"""Streams of events come to an end: with the job, however it ends, and with the server."""

import io
import json
import threading
from contextlib import contextmanager

import httpx

from benchmarks.ports import free_port
from service.observability import make_log
from service.serving import Server
from tests.service_parts import app_for, running

JOBS = "/v1/jobs"
FORM = {"kind": (None, "samples"), "count": (None, "3")}


def events(response):
    """Names and data of the events, as they come."""
    name = None
    for line in response.iter_lines():
        if line.startswith("event: "):
            name = line.removeprefix("event: ")
        elif line.startswith("data: "):
            yield name, json.loads(line.removeprefix("data: "))


def test_the_stream_of_a_job_that_is_deleted_ends_as_others_do(tmp_path):
    app, log = app_for(tmp_path), io.StringIO()
    app.state.services.jobs.log = make_log("debug", log)
    with running(app) as client:
        job = client.post(JOBS, files=FORM).json()
        with client.stream("GET", job["links"]["events"]) as response:
            told = events(response)
            assert next(told)[0] == "progress"
            app.state.services.jobs.forget(job["id"])
            ((name, last),) = told
    assert (name, last["id"], last["state"]) == ("end", job["id"], "cancelled")
    assert "deleted" in last["problem"]


@contextmanager
def stoppable(app):
    """A client of the program's server, and how to begin its end."""
    server = Server(app, lambda: None)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started and thread.is_alive():
        thread.join(0.01)
    address = f"http://127.0.0.1:{app.state.services.settings.port}"
    with httpx.Client(base_url=address, timeout=60.0) as client:
        yield client, server
    server.should_exit = True
    thread.join(60.0)
    assert not thread.is_alive()


def test_streams_end_when_the_server_begins_to_shut_down(tmp_path):
    log = io.StringIO()
    with stoppable(app_for(tmp_path, log=log, port=free_port())) as (client, server):
        place = client.post(JOBS, files=FORM).json()["links"]["events"]
        with client.stream("GET", place) as response:
            told = events(response)
            assert next(told)[0] == "progress"
            server.should_exit = True
            assert list(told) == []  # the client asks again, elsewhere
    entries = [json.loads(line) for line in log.getvalue().splitlines()]
    assert {"stopped"} <= {entry["event"] for entry in entries}
    assert all(entry["level"] == "info" for entry in entries)
