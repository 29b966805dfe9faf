"""What goes wrong around the service: a full disk, a database that restarts, slow clients, clients that vanish.

    python -m benchmarks.load.faults

The full disk and PostgreSQL want root, for a small file system and a server of their own. Each line says what happened
and whether the service went on as it should.
"""

import os
import shutil
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import typer

from benchmarks.load.figures import Figure, at_most, holds, say, told
from benchmarks.load.jobs import begin_job, wait_for
from benchmarks.load.traffic import MASK
from benchmarks.server import Server, serving

#: Clients that are slow or vanish at the same time.
CLIENTS = 50
_POSTGRES = sorted(Path("/usr/lib/postgresql").glob("*/bin"))


def main() -> None:
    """All of them, one after the other."""
    say(measure())


def measure() -> list[Figure]:
    """What each fault does to the service."""
    found = clients()
    if os.geteuid() != 0:
        return [*found, told("full disk and PostgreSQL", "not run, they want root")]
    return [*found, *full_disk(), *(database_restart() if _POSTGRES else [])]


def clients() -> list[Figure]:
    """Clients that send a byte a second, and clients that go away in the middle."""
    with serving(()) as server:
        answer_s(server)
        alone_s = min(answer_s(server) for _ in range(3))
        with slow_clients(server):
            beside_s = min(answer_s(server) for _ in range(3))
        began = time.monotonic()
        for _ in range(CLIENTS):
            vanish(server)
        wait_for(lambda: idle(server), 60.0)
        drained_s = time.monotonic() - began
        after_s = min(answer_s(server) for _ in range(3))
    return [
        at_most(f"a request beside {CLIENTS} slow clients, over alone", beside_s / alone_s, 1.5),
        at_most(f"work of {CLIENTS} clients that vanished ended after", drained_s, 30.0, " s", 1),
        at_most("a request afterwards, over alone", after_s / alone_s, 1.5),
    ]


def full_disk() -> list[Figure]:
    """A job meets a full disk, waits, and goes on when there is room."""
    with tempfile.TemporaryDirectory() as folder, small_disk(Path(folder), "6m"):
        settings = {"MORPHOFLOW_RESULTS_FOLDER": f"{folder}/results", "MORPHOFLOW_JOB_WORKERS": "1"}
        with serving((), settings) as server:
            ballast = Path(folder) / "ballast"
            ballast.write_bytes(b"\0" * (5 * 2**20))
            place = begin_job(server.client, 8)
            time.sleep(12.0)
            before = server.client.get(place).json()
            ballast.unlink()
            after = end_of(server, place)
    value = f"{before['state']} with {before['done']} of 8, with room again {after['state']} with {after['done']}"
    return [holds("a job on a full disk", value, "waits, then done", reached=_went_on(before, after, 8))]


def database_restart() -> list[Figure]:
    """PostgreSQL stops at once (as if its machine lost power) and comes back in the middle of a job."""
    with own_postgres() as (url, control):
        settings = {"MORPHOFLOW_JOBS_DATABASE": url, "MORPHOFLOW_JOB_WORKERS": "1", "MORPHOFLOW_JOB_NICE": "5"}
        with serving((), settings) as server:
            place = begin_job(server.client, 24)
            wait_for(lambda: server.client.get(place).json()["done"] > 0, 120.0)
            before = server.client.get(place).json()
            control("stop", "-m", "immediate")
            refused = server.client.get(place).status_code
            served_s = answer_s(server)
            control("start")
            after = end_of(server, place)
    return [
        holds("jobs while PostgreSQL is down", str(refused), "503", reached=refused == 503),
        told("a reconstruction while it is down", f"{served_s:.2f} s"),
        holds(
            "the job when it is up again",
            f"{after['state']} with {after['done']} of 24",
            "done",
            reached=_went_on(before, after, 24),
        ),
    ]


def _went_on(before: dict[str, object], after: dict[str, object], count: int) -> bool:
    return before["state"] in ("queued", "running") and after["state"] == "done" and after["done"] == count


def answer_s(server: Server) -> float:
    """Time (s) of one reconstruction."""
    began = time.perf_counter()
    files = {"mask": ("mask.nii.gz", MASK.read_bytes())}
    form = {"model": "hippocampus", "uncertainty": "none"}
    server.client.post("/v1/reconstructions", files=files, data=form).raise_for_status()
    return time.perf_counter() - began


@contextmanager
def slow_clients(server: Server) -> Iterator[None]:
    """Clients that send one byte a second of a request, while the context lasts."""
    stop = threading.Event()
    with ExitStack() as stack:
        for _ in range(CLIENTS):
            connection = stack.enter_context(connected(server))
            connection.sendall(b"POST /v1/reconstructions HTTP/1.1\r\nHost: a\r\nContent-Length: 100000\r\n")
            threading.Thread(target=_drip, args=(connection, stop), daemon=True).start()
        try:
            yield
        finally:
            stop.set()


def _drip(connection: socket.socket, stop: threading.Event) -> None:
    while not stop.wait(1.0):
        try:
            connection.sendall(b"X")
        except OSError:
            return


def vanish(server: Server) -> None:
    """Send a whole request and go away before the answer."""
    client = httpx.Client(base_url=server.client.base_url, timeout=0.05)
    try:
        files = {"mask": ("mask.nii.gz", MASK.read_bytes())}
        client.post("/v1/reconstructions", files=files, data={"model": "hippocampus"})
    except httpx.TransportError:
        pass
    finally:
        client.close()


def connected(server: Server) -> socket.socket:
    """A connection without a library between."""
    return socket.create_connection((server.client.base_url.host, server.client.base_url.port or 80), timeout=10.0)


def idle(server: Server) -> bool:
    """Whether no work runs or waits."""
    lines = server.client.get("/metrics").text.splitlines()
    figures = [
        line.split()[1] for line in lines if line.startswith(("morphoflow_work_running ", "morphoflow_work_waiting "))
    ]
    return figures == ["0.0", "0.0"]


def end_of(server: Server, place: str) -> dict[str, object]:
    """A job that has ended, or what it is after two minutes."""

    def over() -> bool:
        answer = server.client.get(place)
        return answer.is_success and answer.json()["state"] not in ("queued", "running")

    wait_for(over, 180.0)
    found: dict[str, object] = server.client.get(place).json()
    return found


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[None]:
    """A file system of so many bytes in a folder."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


@contextmanager
def own_postgres() -> Iterator[tuple[str, Callable[..., None]]]:
    """A server of its own: address of a database, and `pg_ctl` for it."""
    folder = Path(tempfile.mkdtemp())
    shutil.chown(folder, "postgres")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    data = folder / "data"

    def run(program: str, *words: str) -> None:
        command = ["runuser", "-u", "postgres", "--", str(_POSTGRES[-1] / program), "-D", str(data), *words]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd="/")

    def control(*words: str) -> None:
        run("pg_ctl", "-w", "-l", str(folder / "log"), *words)

    run("initdb", "--auth=trust")
    with (data / "postgresql.conf").open("a") as settings:
        settings.write(f"port = {port}\nlisten_addresses = '127.0.0.1'\nunix_socket_directories = '{folder}'\n")
    control("start")
    try:
        yield f"postgresql://postgres@127.0.0.1:{port}/postgres", control
    finally:
        control("stop", "-m", "immediate")
        shutil.rmtree(folder)


if __name__ == "__main__":
    typer.run(main)
