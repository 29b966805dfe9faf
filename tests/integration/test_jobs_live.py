"""The programs themselves: `serve` with its workers killed, and the commands `jobs`."""

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
import zipfile
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from benchmarks.ports import free_port
from service.adapters.jobs.client import DbosJobs
from service.adapters.jobs.database import Leases
from tests.job_parts import ended
from tests.service_parts import mask_bytes
from tests.waiting import until

PROGRAM = """
import sys
from service import cli
from service.model_registry import ModelRegistry
from tests.analytic_model import ellipsoid_model
sys.exit(cli.main(sys.argv[1:], lambda settings: ModelRegistry({"ellipsoid": ellipsoid_model("ellipsoid")})))
"""


@pytest.fixture
def environment(tmp_path, repository: Path):
    program = tmp_path / "program" / "sitecustomize.py"
    program.parent.mkdir()
    # What `serve` starts beside itself is the same program, so it must find the same model.
    program.write_text(
        "import service.model_registry as registry\n"
        "from tests.analytic_model import ellipsoid_model\n"
        "def load_registry(settings):\n"
        "    return registry.ModelRegistry({'ellipsoid': ellipsoid_model('ellipsoid')})\n"
        "registry.load_registry = load_registry\n"
    )
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join((str(program.parent), str(repository))),
        "MORPHOFLOW_RESULTS_FOLDER": str(tmp_path / "state" / "results"),
        "MORPHOFLOW_SHIPPED_MODELS": "false",
        "MORPHOFLOW_LOG_LEVEL": "warning",
        "MORPHOFLOW_JOB_NICE": "0",
    }


@contextmanager
def serving(environment):
    port = free_port()
    command = [sys.executable, "-c", PROGRAM, "serve", "--port", str(port)]
    with (
        subprocess.Popen(command, env=environment) as server,
        httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60.0) as client,
    ):
        try:
            limit = time.monotonic() + 60.0
            while time.monotonic() < limit:
                try:
                    client.get("/readyz")
                    break
                except httpx.TransportError:
                    time.sleep(0.1)
            yield client, server
        finally:
            server.send_signal(signal.SIGTERM)


def workers(server):
    children = Path(f"/proc/{server.pid}/task").glob("*/children")
    pids = [int(pid) for file in children for pid in file.read_text().split()]
    return [pid for pid in pids if b"worker" in Path(f"/proc/{pid}/cmdline").read_bytes()]


@pytest.mark.slow
def test_a_job_outlives_its_worker_and_its_service(environment):
    with serving(environment) as (client, server):
        parts = {"kind": (None, "samples"), "count": (None, "60")}
        place = client.post("/v1/jobs", files=parts).headers["location"]
        while client.get(place).json()["done"] < 4:
            time.sleep(0.05)
        for pid in workers(server):
            os.kill(pid, signal.SIGKILL)
        done = client.get(place).json()["done"]
        while client.get(place).json()["done"] < done + 4:
            time.sleep(0.05)
        server.kill()
    with serving(environment) as (client, _):
        summary = ended(client, place)
        assert (summary["state"], summary["done"]) == ("done", 60)


@pytest.mark.slow
def test_a_command_does_its_job_itself_once_the_last_worker_is_gone(environment, tmp_path):
    file, shapes = tmp_path / "state" / "jobs.sqlite", tmp_path / "shapes.zip"
    jobs = DbosJobs(f"sqlite:///{file}")
    assert jobs.unfinished() == 0
    leases = Leases(f"sqlite:///{file}")
    leases.renew("gone-0")  # as a worker does, which dies once the command has seen it
    words = ("jobs", "sample", "--count", "5", "--output", str(shapes))
    with subprocess.Popen([sys.executable, "-c", PROGRAM, *words], env=environment) as command:
        try:
            while not jobs.unfinished() and command.poll() is None:
                leases.renew("gone-0")
                time.sleep(0.1)
            time.sleep(1.0)
            assert jobs.workers(10.0) == 1
            leases.lapse("gone-0")
            until(lambda: command.poll() is not None)
        finally:
            command.kill()
    assert command.returncode == 0
    with zipfile.ZipFile(shapes) as archive:
        assert len(archive.namelist()) == 6
    with sqlite3.connect(file) as connection:
        names = [name for (name,) in connection.execute("SELECT executor FROM morphoflow_leases")]
    connection.close()
    assert [name.rpartition("-")[2] for name in names] == [f"{command.pid}000"]  # no slot that another may still hold
    leases.close()
    jobs.close()


@pytest.mark.slow
def test_commands_do_jobs_by_themselves(environment, tmp_path):
    def command(*words):
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, "jobs", *words],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, done.stdout, done.stderr

    shapes = tmp_path / "shapes.zip"
    status, told, _ = command("sample", "--count", "5", "--key", "one", "--output", str(shapes), "--json")
    assert status == 0
    assert json.loads(told)["state"] == "done"
    with zipfile.ZipFile(shapes) as archive:
        assert len(archive.namelist()) == 6
    again = command("sample", "--count", "5", "--key", "one", "--json")[1]
    assert json.loads(again)["id"] == json.loads(told)["id"]

    assert command("sample", "--count", "6", "--key", "one")[0] == 2

    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "a.nii").write_bytes(mask_bytes())
    status, told, _ = command("reconstruct", str(tmp_path / "masks"), "--uncertainty", "none", "--json")
    identifier = json.loads(told)["id"]
    assert (status, json.loads(told)["state"]) == (0, "queued")
    assert json.loads(command("cancel", identifier, "--json")[1])["state"] == "cancelled"
    assert command("watch", identifier)[0] != 0
    assert command("watch", "nothing")[0] == 2
