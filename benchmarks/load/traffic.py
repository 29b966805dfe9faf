"""Traffic by locust, in a process of its own, and its figures."""

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.server import Server

MASK = Path("docs/examples/hippocampus_three_slices.nii.gz")
_USERS = Path(__file__).with_name("users.py")


@dataclass(frozen=True)
class Traffic:
    """Answers of one run: how long they took, how many failed, over which time, and what the sending itself took."""

    seconds: tuple[float, ...]
    failed: int
    duration_s: float
    sender_cpu_s: float

    @property
    def rate(self) -> float:
        """Answers a second."""
        return len(self.seconds) / self.duration_s

    def quantile_s(self, share: float) -> float:
        """Time that so many of the answers kept within."""
        return float(np.quantile(self.seconds, share, method="higher")) if self.seconds else float("nan")


def send(
    server: Server, *, users: int, rate: float = 0.0, duration_s: float, kind: str = "none", by_chance: bool = False
) -> Traffic:
    """Let so many users send requests; `rate` of all of them together (1/s), 0 for one request after the other.

    Args:
        by_chance: whether users' requests come at random times (Poisson) rather than at an even pace.
        kind: uncertainty of the reconstructions, or ``mixed`` for requests of every kind.
    """
    command = [sys.executable, "-m", "locust", "-f", str(_USERS), "--headless", "--json", "--skip-log"]
    command += ["-u", str(users), "-r", str(users), "-t", f"{duration_s:.0f}s", "-H", str(server.client.base_url)]
    with tempfile.TemporaryDirectory() as folder:
        times = Path(folder) / "times.json"
        environment = {
            **os.environ,
            "LOAD_MASK": str(MASK.resolve()),
            "LOAD_RATE": str(rate / users),
            "LOAD_USERS": str(users),
            "LOAD_KIND": kind,
            "LOAD_CHANCE": "1" if by_chance else "",
            "LOAD_TIMES": str(times),
        }
        done = subprocess.run([*command, "--stop-timeout", "60"], env=environment, check=False, capture_output=True)
        if not done.stdout.strip() or not times.exists():
            raise SystemExit(f"locust did not run: {done.stderr.decode(errors='replace')[-500:]}")
        entries, kept = json.loads(done.stdout), json.loads(times.read_text())
    first = min(entry["start_time"] for entry in entries)
    span_s = max(max(entry["last_request_timestamp"] for entry in entries) - first, 1e-9)
    failed = sum(entry["num_failures"] for entry in entries)
    return Traffic(tuple(kept["seconds"]), failed, span_s, kept["own_cpu_s"])
