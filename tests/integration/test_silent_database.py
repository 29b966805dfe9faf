"""A database that accepts connections and never answers holds up what is about jobs, for a while, and nothing else."""

import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from service.routes.turns import TURN_S
from tests.service_parts import NAME, app_for, mask_parts, running

JOB = "/v1/jobs/978c126b-b4af-545f-93fa-20cf3c9be9b8"


@pytest.fixture
def silent_url():
    held, listener = [], socket.create_server(("127.0.0.1", 0), backlog=200)

    def accept():
        while True:
            try:
                held.append(listener.accept()[0])
            except OSError:
                return

    thread = threading.Thread(target=accept, daemon=True)
    thread.start()
    yield f"postgresql://nobody@127.0.0.1:{listener.getsockname()[1]}/nothing"
    listener.shutdown(socket.SHUT_RDWR)
    thread.join(10.0)
    for connection in (listener, *held):
        connection.close()


def timed(client, method, path, **parts):
    began = time.monotonic()
    return client.request(method, path, **parts), time.monotonic() - began


def test_what_needs_no_job_is_answered_while_many_wait_for_the_database(tmp_path, silent_url):
    asking = ThreadPoolExecutor(60)
    with running(app_for(tmp_path, jobs_database=silent_url, max_waiting=60)) as client, asking:
        client.post("/v1/reconstructions", files=mask_parts())
        address = str(client.base_url)
        polls = [asking.submit(httpx.get, address + JOB, timeout=60.0) for _ in range(50)]
        time.sleep(0.5)
        answers = {
            path: timed(client, method, path, **parts)
            for method, path, parts in (
                ("GET", "/healthz", {}),
                ("GET", "/metrics", {}),
                ("GET", f"/v1/models/{NAME}", {}),
                ("POST", "/v1/reconstructions", {"files": mask_parts()}),
                ("GET", "/metrics?again", {}),
            )
        }
        told = [poll.result() for poll in polls]
    assert {path: answer.status_code // 100 for path, (answer, _) in answers.items()} == dict.fromkeys(answers, 2)
    assert max(seconds for _, seconds in answers.values()) < TURN_S
    assert "morphoflow_jobs_waiting_parts NaN" in answers["/metrics"][0].text
    assert {answer.status_code for answer in told} == {503}
    assert all(int(answer.headers["retry-after"]) > 0 for answer in told)
