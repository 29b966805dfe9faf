"""A database that accepts connections and never answers holds up what is about jobs, for a while, and nothing else."""

import socket
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import httpx
import pytest

from service.adapters.jobs.client import DbosJobs
from service.errors import UnknownJob
from service.routes.dependencies import services_of
from service.routes.turns import TURNS, Turns
from tests.service_parts import NAME, app_for, mask_parts, running

JOB = "/v1/jobs/978c126b-b4af-545f-93fa-20cf3c9be9b8"


@dataclass(frozen=True)
class Silent:
    """A database that accepts connections, and whether it has accepted one."""

    url: str
    connected: threading.Event


@pytest.fixture
def silent():
    held, listener = [], socket.create_server(("127.0.0.1", 0), backlog=200)
    connected = threading.Event()

    def accept():
        while True:
            try:
                held.append(listener.accept()[0])
                connected.set()
            except OSError:
                return

    thread = threading.Thread(target=accept, daemon=True)
    thread.start()
    yield Silent(f"postgresql://nobody@127.0.0.1:{listener.getsockname()[1]}/nothing", connected)
    listener.shutdown(socket.SHUT_RDWR)
    thread.join(10.0)
    for connection in (listener, *held):
        connection.close()


OTHERS = (
    ("GET", "/healthz", {}),
    ("GET", "/metrics", {}),
    ("GET", f"/v1/models/{NAME}", {}),
    ("POST", "/v1/reconstructions", {"files": mask_parts()}),
    ("GET", "/metrics?again", {}),
)


def polls(asking, client):
    """Many requests for a job at the same time."""
    return [asking.submit(httpx.get, str(client.base_url) + JOB, timeout=120.0) for _ in range(50)]


def answers_of(client):
    """What is answered to requests that need no job."""
    return {path: client.request(method, path, **parts) for method, path, parts in OTHERS}


class HeldJobs(DbosJobs):
    """Knows of no job, and says so once it is let go."""

    def __init__(self, url):
        super().__init__(url)
        self.asked, self.released = threading.Semaphore(0), threading.Event()

    def status(self, _):
        self.asked.release()
        self.released.wait(60.0)
        raise UnknownJob("There is no job of this identifier.")


class PatientTurns(Turns):
    """Nobody is sent away, however long a turn or an answer takes."""

    def __init__(self):
        super().__init__(wait_s=120.0)

    async def run(self, call, *arguments, limit_s=None):  # noqa: ARG002
        return await super().run(call, *arguments, limit_s=None)


def test_what_needs_no_job_is_answered_before_any_of_many_that_wait_for_jobs(tmp_path):
    app, held = app_for(tmp_path, max_waiting=60), HeldJobs(f"sqlite:///{tmp_path / 'jobs.sqlite'}")
    services = replace(app.state.services, jobs=held, turns=PatientTurns())
    app.dependency_overrides[services_of] = lambda: services
    with running(app) as client, ThreadPoolExecutor(60) as asking:
        waiting = polls(asking, client)
        assert all(held.asked.acquire(timeout=60.0) for _ in range(TURNS))
        answers = answers_of(client)
        assert not any(poll.done() for poll in waiting)
        held.released.set()
        told = [poll.result() for poll in waiting]
    assert {path: answer.status_code for path, answer in answers.items()} == {
        path: 201 if method == "POST" else 200 for method, path, _ in OTHERS
    }
    assert {answer.status_code for answer in told} == {404}


def test_a_silent_database_is_a_503_to_those_that_ask_for_jobs_and_holds_up_nobody_else(tmp_path, silent):
    with (
        running(app_for(tmp_path, jobs_database=silent.url, max_waiting=60)) as client,
        ThreadPoolExecutor(60) as asking,
    ):
        waiting = polls(asking, client)
        assert silent.connected.wait(60.0)
        answers = answers_of(client)
        told = [poll.result() for poll in waiting]
    assert {path: answer.status_code // 100 for path, answer in answers.items()} == dict.fromkeys(answers, 2)
    assert "morphoflow_jobs_waiting_parts NaN" in answers["/metrics"].text
    assert {answer.status_code for answer in told} == {503}
    assert all(int(answer.headers["retry-after"]) > 0 for answer in told)
