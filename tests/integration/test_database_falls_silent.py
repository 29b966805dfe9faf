"""A database whose connections fall silent in the middle: every request about jobs is told, and it is found again."""

import os
import select
import socket
import threading
import time
import uuid
from concurrent.futures import ThreadPoolExecutor

import httpx
import psycopg
import pytest

from tests.service_parts import app_for, running

FORM = {"kind": (None, "samples"), "count": (None, "2")}
POSTGRES = os.environ.get("MORPHOFLOW_TEST_POSTGRES", "postgresql://postgres@127.0.0.1:5432")


class Road:
    """The way to a server: connections over it can fall silent, without a word to either end."""

    def __init__(self, target):
        self._target = target
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=200)
        self._open = threading.Event()
        self._open.set()
        threading.Thread(target=self._accept, daemon=True).start()
        self.port = self._listener.getsockname()[1]

    def fall_silent(self):
        """Nothing comes through any more; new connections are accepted."""
        self._open.clear()

    def open_for_others(self):
        """The connections that there are stay silent; new ones come through."""
        self._open = threading.Event()
        self._open.set()

    def close(self):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self):
        while True:
            try:
                near = self._listener.accept()[0]
            except OSError:
                return
            threading.Thread(target=self._carry, args=(near, self._open), daemon=True).start()

    def _carry(self, near, opened):
        with near, socket.create_connection(self._target) as far:
            other = {near: far, far: near}
            while True:
                for end in select.select([near, far], [], [])[0]:
                    data = end.recv(1 << 16)
                    opened.wait()
                    if not data:
                        return
                    other[end].sendall(data)


@pytest.fixture
def road():
    name = f"jobs_{uuid.uuid4().hex}"
    try:
        connection = psycopg.connect(f"{POSTGRES}/postgres", autocommit=True, connect_timeout=2)
    except psycopg.OperationalError:
        pytest.skip("no PostgreSQL on this machine (MORPHOFLOW_TEST_POSTGRES)")
    connection.execute(f"CREATE DATABASE {name}")
    road = Road((connection.info.host, connection.info.port))
    road.url = f"postgresql://{connection.info.user}@127.0.0.1:{road.port}/{name}"
    yield road
    road.close()
    connection.execute(f"DROP DATABASE {name} WITH (FORCE)")
    connection.close()


def test_a_database_that_falls_silent_is_told_and_found_again(tmp_path, road):
    with running(app_for(tmp_path, jobs_database=road.url)) as client, ThreadPoolExecutor(40) as asking:

        def ask(path, _):
            return httpx.request(*path, timeout=60.0, files=FORM if path[0] == "POST" else None)

        address = str(client.base_url)
        place = client.post("/v1/jobs", files=FORM).headers["location"]
        paths = [("GET", f"{address}{place}"), ("DELETE", f"{address}{place}"), ("POST", f"{address}/v1/jobs")]
        assert {answer.status_code for answer in asking.map(ask, paths[:1] * 12, range(12))} == {200}
        road.fall_silent()
        answers = list(asking.map(ask, paths * 8, range(24)))
        assert {answer.status_code for answer in answers} == {503}
        assert all(int(answer.headers["retry-after"]) > 0 for answer in answers)
        assert "morphoflow_jobs_waiting_parts NaN" in client.get("/metrics").text
        road.open_for_others()
        limit = time.monotonic() + 60.0
        while client.get(place).status_code != 200:
            assert time.monotonic() < limit
