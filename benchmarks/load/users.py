"""What locust runs: users that send requests made beforehand, as cheaply as can be, and keep each answer's time.

The environment says how: LOAD_MASK (file), LOAD_RATE (requests a second of each user, 0 for as many as are answered),
LOAD_USERS, LOAD_CHANCE (requests come by chance rather than at an even pace), LOAD_KIND (`none`, `laplace`:
reconstructions; `mixed`: of every kind that the service answers) and LOAD_TIMES (file that the times of answers (s)
and the processor time of the sending are written to at the end).
"""

import itertools
import json
import os
import random
import time
from pathlib import Path
from typing import Any

from locust import FastHttpUser, events, task
from urllib3 import encode_multipart_formdata

RATE, USERS = float(os.environ.get("LOAD_RATE", "0")), int(os.environ.get("LOAD_USERS", "1"))
KIND = os.environ.get("LOAD_KIND", "none")
CHANCE = bool(os.environ.get("LOAD_CHANCE"))
TIMES: list[float] = []
#: Processor time (s) of this process when the sending began.
BEGUN: list[float] = []
#: Body and headers.
Prepared = tuple[bytes, dict[str, str]]


def prepared(accept: str, **form: str) -> Prepared:
    """Body and headers of a request to reconstruct."""
    mask = ("mask.nii.gz", Path(os.environ["LOAD_MASK"]).read_bytes(), "application/gzip")
    body, kind = encode_multipart_formdata({"mask": mask, "model": "hippocampus", **form})
    return body, {"Content-Type": kind, "Accept": accept}


PLAIN = prepared("model/stl", uncertainty="none")
LAPLACE = prepared("model/stl", uncertainty="laplace")
COARSE = prepared("application/json", uncertainty="none", resolution_mm="4")
SURE = prepared("application/x-ply", uncertainty="laplace", resolution_mm="4")
#: Requests in turn: most are the smallest that the service answers, all kinds are among them.
KINDS: dict[str, list[Prepared | None]] = {
    "none": [PLAIN],
    "laplace": [LAPLACE],
    "mixed": [*[COARSE] * 8, SURE, None],
}
TURNS = KINDS[KIND]


def _keep(response_time: float, exception: BaseException | None, **_: object) -> None:
    if exception is None:
        TIMES.append(response_time / 1000.0)


def _begin(**_: object) -> None:
    BEGUN.append(time.process_time())


def _write(**_: object) -> None:
    own_cpu_s = time.process_time() - BEGUN[0]
    Path(os.environ["LOAD_TIMES"]).write_text(json.dumps({"seconds": TIMES, "own_cpu_s": own_cpu_s}))


events.test_start.add_listener(_begin)
events.request.add_listener(_keep)
events.quitting.add_listener(_write)


class Caller(FastHttpUser):
    """Sends one request after the other, or one at each beat; the beats of all users are evenly apart."""

    numbers = itertools.count()
    network_timeout = connection_timeout = 120.0

    def on_start(self) -> None:
        """Wait for the own place among the beats."""
        self.turn = next(self.numbers)
        self.beat = time.monotonic()
        if RATE:
            time.sleep(self.turn / (RATE * USERS))
            self.beat = time.monotonic()

    def wait_time(self) -> float:
        """Time (s) until the own next beat; beats that were missed are left out."""
        if not RATE:
            return 0.0
        pause = random.expovariate(RATE) if CHANCE else 1.0 / RATE
        self.beat = max(self.beat + pause, time.monotonic())
        return self.beat - time.monotonic()

    @task
    def ask(self) -> None:
        """One request."""
        request = TURNS[self.turn % len(TURNS)]
        self.turn += 1
        if request is None:
            self.client.get(f"/v1/models/hippocampus/samples/{self.turn}?format=stl&spacing_mm=3", name="sample")
        else:
            body: Any = request[0]  # bytes are sent as they are, though not announced
            self.client.post("/v1/reconstructions", data=body, headers=request[1])
