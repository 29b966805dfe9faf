"""The program as people start it: `serve` in a process of its own, and commands on a terminal and in a pipe."""

import json
import os
import pty
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import httpx

from benchmarks.ports import free_port
from benchmarks.server import cpu_s
from benchmarks.server import serving as shipped_service
from tests.service_parts import NAME, app_for, mask_parts, running

PROGRAM = """
import sys
from service.cli import main
from service.model_registry import ModelRegistry
from tests.analytic_model import ellipsoid_model
sys.exit(main(sys.argv[1:], lambda settings: ModelRegistry({"ellipsoid": ellipsoid_model("ellipsoid")})))
"""


def command(*words):
    return [sys.executable, "-c", PROGRAM, *map(str, words)]


@contextmanager
def serving(repository, folder, **environment):
    port = free_port()
    variables = {**os.environ, "MORPHOFLOW_RESULTS_FOLDER": str(folder), **environment}
    words = command("serve", "--port", port)
    with subprocess.Popen(words, cwd=repository, env=variables, stderr=subprocess.PIPE, text=True) as process:
        try:
            wait_for(process, port)
            yield process, f"http://127.0.0.1:{port}"
        finally:
            process.kill()


def wait_for(process, port):
    while process.poll() is None:
        try:
            httpx.get(f"http://127.0.0.1:{port}/healthz")
        except httpx.TransportError:
            time.sleep(0.02)
        else:
            return


def test_serve_answers_prints_a_request_that_works_and_ends_when_told(repository, tmp_path):
    with serving(repository, tmp_path / "results") as (process, address):
        made = httpx.post(f"{address}/v1/reconstructions", files=mask_parts(), timeout=60.0)
        assert made.status_code == 201
        process.send_signal(signal.SIGTERM)
        entries = [json.loads(line) for line in process.communicate(timeout=120.0)[1].splitlines()]
    assert process.returncode == 0
    events = [entry["event"] for entry in entries]
    assert {"started", "request", "stopped"} <= set(events)
    (example,) = [entry["request"] for entry in entries if entry["event"] == "example"]
    assert example.startswith("curl ")
    assert address in example


def read_until(stream, event):
    """Pass over the entries of a log up to this one."""
    for line in stream:
        if json.loads(line)["event"] == event:
            return
    raise AssertionError(f"the log ended without {event}")


def test_workers_leave_when_the_server_is_told_to_and_not_when_its_last_request_has_ended(repository, tmp_path):
    with serving(repository, tmp_path / "results", MORPHOFLOW_SHIPPED_MODELS="false") as (process, address):
        read_until(process.stderr, "worker started")
        host, _, port = address.removeprefix("http://").partition(":")
        with socket.create_connection((host, int(port))) as slow:
            slow.sendall(b"POST /v1/planes HTTP/1.1\r\nHost: x\r\nContent-Type: multipart/form-data; boundary=b\r\n")
            slow.sendall(b"Content-Length: 1000\r\nExpect: 100-continue\r\n\r\n")
            assert slow.recv(100).startswith(b"HTTP/1.1 100")
            process.send_signal(signal.SIGTERM)
            read_until(process.stderr, "worker stopped")
            assert process.poll() is None
        read_until(process.stderr, "stopped")
        assert process.wait(timeout=60.0) == 0


def test_an_address_with_a_slash_too_many_leads_to_the_right_one_on_whatever_server_the_client_asked(tmp_path):
    with running(app_for(tmp_path)) as client:
        answer = client.get("/v1/models/?a=b", headers={"Host": "evil.example.org"})
        assert (answer.status_code, answer.headers["location"]) == (307, "/v1/models?a=b")
        assert client.get("/v1/models/", follow_redirects=True).json() == client.get("/v1/models").json()
        assert client.get(f"{client.base_url}//evil.example.org/").status_code == 404
    with running(app_for(tmp_path), root_path="/shape") as client:
        assert client.get("/v1/models/").headers["location"] == "/shape/v1/models"


def test_results_are_there_after_a_crash(repository, tmp_path):
    with serving(repository, tmp_path / "results") as (process, address):
        links = httpx.post(f"{address}/v1/reconstructions", files=mask_parts(), timeout=60.0).json()["links"]
        process.kill()
    with serving(repository, tmp_path / "results") as (_, address):
        assert httpx.get(f"{address}{links['mesh']}", timeout=60.0).status_code == 200


def run_on_terminal(repository, *words):
    """Exit status, and what a terminal as standard error shows."""
    master, slave = pty.openpty()
    process = subprocess.Popen(command(*words), cwd=repository, stdout=subprocess.PIPE, stderr=slave)
    os.close(slave)
    process.communicate(timeout=120.0)
    shown = b""
    while True:
        try:
            data = os.read(master, 4096)
        except OSError:
            break
        if not data:
            break
        shown += data
    os.close(master)
    return process.returncode, shown.decode(errors="replace")


def test_a_bar_shows_on_a_terminal_and_none_in_a_pipe(repository, tmp_path):
    status, shown = run_on_terminal(repository, "sample", "--count", 2, "--output", tmp_path / "a")
    assert (status, "seed" in shown) == (0, True)
    piped = subprocess.run(
        command("sample", "--count", 2, "--output", tmp_path / "b"), cwd=repository, capture_output=True, check=True
    )
    assert piped.stderr == b""


def test_behind_a_proxy_links_carry_its_prefix(tmp_path):
    app = app_for(tmp_path, api_keys=("k",))
    with running(app, headers={"X-API-Key": "k"}, root_path="/shape") as client:
        made = client.post("/v1/reconstructions", files=mask_parts())
        assert made.headers["location"].startswith("/shape/v1/reconstructions/")
        assert client.get(made.headers["location"].removeprefix("/shape")).status_code == 200
        assert client.get("/v1/models").json()["models"][0]["link"] == f"/shape/v1/models/{NAME}"
        assert httpx.get(f"{client.base_url}/healthz").status_code == 200
        assert httpx.get(f"{client.base_url}/v1/models").status_code == 401


def test_requests_at_the_same_time_are_computed_in_several_processes(shipped_bundles, repository):  # noqa: ARG001
    mask = (repository / "docs" / "examples" / "hippocampus_three_slices.nii.gz").read_bytes()

    def ask(_):
        form, accept = {"model": "hippocampus", "uncertainty": "none"}, {"Accept": "model/stl"}
        url = f"{server.client.base_url}/v1/reconstructions"
        return httpx.post(url, files=mask_parts(mask), data=form, headers=accept, timeout=60.0)

    with shipped_service((), {"MORPHOFLOW_WORKERS": "2"}) as server, ThreadPoolExecutor(4) as pool:
        before = {pid: cpu_s(pid) for pid in server.family()}
        answers = list(pool.map(ask, range(12)))
        worked = [pid for pid in server.family() if cpu_s(pid) - before.get(pid, 0.0) > 0.3]
    assert {answer.status_code for answer in answers} == {200}
    assert len({answer.content for answer in answers}) == 1
    assert len(worked) >= 2
