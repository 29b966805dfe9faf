"""Traffic by locust, in a process of its own, and its figures."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.server import Server

MASK = Path("docs/examples/hippocampus_three_slices.nii.gz")
_USERS = Path(__file__).with_name("users.py")


@dataclass(frozen=True)
class Traffic:
    """Answers of one run: how many, how many failed, how long they took, and over which time."""

    seconds: tuple[float, ...]
    failed: int
    duration_s: float

    @property
    def rate(self) -> float:
        """Answers a second."""
        return len(self.seconds) / self.duration_s

    def quantile_s(self, share: float) -> float:
        """Time that so many of the answers kept within."""
        return float(np.quantile(self.seconds, share, method="higher")) if self.seconds else float("nan")


def send(server: Server, *, users: int, rate: float = 0.0, duration_s: float, uncertainty: str = "none") -> Traffic:
    """Let so many users send masks; `rate` of all of them together (1/s), 0 for one request after the other."""
    command = [sys.executable, "-m", "locust", "-f", str(_USERS), "--headless", "--json", "--skip-log"]
    command += ["-u", str(users), "-r", str(users), "-t", f"{duration_s:.0f}s", "-H", str(server.client.base_url)]
    environment = {
        **os.environ,
        "LOAD_MASK": str(MASK.resolve()),
        "LOAD_RATE": str(rate / users),
        "LOAD_UNCERTAINTY": uncertainty,
    }
    done = subprocess.run([*command, "--stop-timeout", "60"], env=environment, check=False, capture_output=True)
    if not done.stdout.strip():
        raise SystemExit(f"locust did not run: {done.stderr.decode(errors='replace')[-500:]}")
    (entry,) = json.loads(done.stdout)
    seconds = [float(ms) / 1000.0 for ms, count in entry["response_times"].items() for _ in range(count)]
    span_s = max(entry["last_request_timestamp"] - entry["start_time"], 1e-9)
    return Traffic(tuple(seconds), entry["num_failures"], span_s)
