"""The real service in a process of its own, and how much memory it took."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

from benchmarks.ports import free_port

START_LIMIT_S = 120.0
STOP_LIMIT_S = 30.0
REQUEST_LIMIT_S = 120.0
_SERVE = "import sys; from service.cli import main; sys.exit(main(sys.argv[1:]))"


@dataclass(frozen=True)
class Server:
    """A running service: its client, its process, and where its log lies."""

    client: httpx.Client
    process: subprocess.Popen[bytes]
    log: Path

    def family(self) -> list[int]:
        """The service's process, and those that it has started."""
        return family(self.process.pid)

    def cpu_s(self) -> float:
        """Time (s) that the processes that live now have computed so far (Linux only)."""
        return sum(cpu_s(pid) for pid in self.family())

    def memory_mib(self) -> float:
        """Resident memory of the process and its children, summed over them (MiB; Linux only)."""
        return sum(_status_kib(pid, "VmRSS:") for pid in self.family()) / 1024.0

    def peak_memory_mib(self) -> float:
        """Largest resident memory of the process and its children so far, summed over them (MiB; Linux only)."""
        return sum(_status_kib(pid, "VmHWM:") for pid in self.family()) / 1024.0


@contextmanager
def serving(models: tuple[Path, ...], settings: Mapping[str, str] | None = None) -> Iterator[Server]:
    """The service with the shipped models and further bundles, on a free local port; gone afterwards.

    Without workers for jobs unless a setting (by its environment variable) says otherwise.
    """
    port = free_port()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as results:
        environment = {
            **os.environ,
            "MORPHOFLOW_RESULTS_FOLDER": str(Path(results) / "results"),
            "MORPHOFLOW_LOG_LEVEL": "warning",
            "MORPHOFLOW_MODELS": os.pathsep.join(str(model.resolve()) for model in models),
            "MORPHOFLOW_JOB_WORKERS": "0",
            **(settings or {}),
        }
        command = [sys.executable, "-c", _SERVE, "serve", "--host", "127.0.0.1", "--port", str(port)]
        log = Path(results) / "service.log"
        with log.open("wb") as stream:
            process = subprocess.Popen(command, env=environment, stderr=stream)
        try:
            with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=REQUEST_LIMIT_S) as client:
                wait_until_ready(client, process, log)
                yield Server(client, process, log)
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(timeout=STOP_LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def wait_until_ready(client: httpx.Client, process: subprocess.Popen[bytes], log: Path) -> None:
    """Return once /readyz says so.

    Raises:
        SystemExit: the process ended or took too long; with the last line that it wrote.
    """
    limit = time.monotonic() + START_LIMIT_S
    while time.monotonic() < limit and process.poll() is None:
        try:
            if client.get("/readyz").is_success:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.05)
    said = log.read_text(errors="replace").strip().splitlines()[-1:]
    raise SystemExit(f"The service did not become ready: {''.join(said)}")


def family(pid: int) -> list[int]:
    """A process and all that it has started (Linux only)."""
    found = [pid]
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            found += family(int(child))
    return found


def _status_kib(pid: int, name: str) -> int:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next((int(line.split()[1]) for line in lines if line.startswith(name)), 0)


def cpu_s(pid: int) -> float:
    """Time (s) that a process has computed so far (Linux only)."""
    words = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
