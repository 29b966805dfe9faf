"""Jobs: what a second worker adds, and what a job in the background costs the requests that somebody waits for.

python -m benchmarks.load.jobs --count 400
"""

import json
import time
from collections.abc import Callable
from datetime import datetime
from typing import Annotated

import httpx
import typer

from benchmarks.load.figures import Figure, at_least, at_most, say, told
from benchmarks.load.traffic import MASK, send
from benchmarks.server import Server, serving


def main(
    count: Annotated[int, typer.Option(min=16, help="Shapes of the jobs.")] = 400,
    duration_s: Annotated[float, typer.Option(min=5.0, help="Of each of the runs of requests.")] = 40.0,
) -> None:
    """Scaling of jobs, their cost for requests, and how soon one stops."""
    say([*scaling(count), *cost(duration_s), *cancelling()])


def scaling(count: int) -> list[Figure]:
    """What a second worker adds."""
    one, two = (job_rate(workers, count) for workers in (1, 2))
    return [
        told("shapes a second, one worker", f"{one:.2f}"),
        told("shapes a second, two workers", f"{two:.2f}"),
        at_least("  ratio", two / one, 1.8),
    ]


def cost(duration_s: float) -> list[Figure]:
    """What a job in the background costs requests."""
    alone_s, beside_s = background(duration_s)
    return [
        told("median of requests alone", f"{alone_s:.3f} s"),
        told("median beside a job", f"{beside_s:.3f} s"),
        at_most("  ratio", beside_s / alone_s, 1.25),
    ]


def job_rate(workers: int, count: int) -> float:
    """Shapes a second of a job, from its first to its last part."""
    with serving((), {"MORPHOFLOW_JOB_WORKERS": str(workers), "MORPHOFLOW_THREADS": "1"}) as server:
        run_job(server.client, 32)  # all workers are there and warm
        place = begin_job(server.client, count)
        began, first = 0.0, 0
        while (job := server.client.get(place).json())["state"] in ("queued", "running"):
            if job["done"] and not first:
                began, first = time.perf_counter(), job["done"]
            time.sleep(0.1)
        return float((count - first) / (time.perf_counter() - began))


def background(duration_s: float) -> tuple[float, float]:
    """Median time (s) of requests, one after the other: alone, and beside a job."""
    with serving((), {"MORPHOFLOW_JOB_WORKERS": "1"}) as server:
        send(server, users=1, duration_s=5.0)
        alone = send(server, users=1, duration_s=duration_s)
        place = begin_job(server.client, 100_000)
        while not server.client.get(place).json()["done"]:
            time.sleep(0.2)
        beside = send(server, users=1, duration_s=duration_s)
        server.client.delete(place)
        return alone.quantile_s(0.5), beside.quantile_s(0.5)


def cancelling() -> list[Figure]:
    """Seconds until a cancelled job says so, and until its worker has stopped, amid a long stage."""
    settings = {"MORPHOFLOW_JOB_WORKERS": "1", "MORPHOFLOW_LOG_LEVEL": "debug"}
    with serving((), settings) as server:
        run_job(server.client, 4)  # the worker is there and warm
        place = begin_ensemble(server.client)
        wait_for(lambda: said(server, "part begun", place) is not None, 60.0)
        time.sleep(0.5)  # the fit is over, the ensemble's members are under way
        asked = time.time()
        state = server.client.delete(place).raise_for_status().json()["state"]
        told_s = time.time() - asked
        wait_for(lambda: said(server, "part ended", place) is not None, 30.0)
        ended = said(server, "part ended", place)
    if state != "cancelled" or ended is None:
        raise SystemExit(f"The job was not cancelled: it is {state}.")
    return [
        at_most("a cancelled job says so after", told_s, 1.0, " s"),
        at_most("and its worker has stopped after", ended - asked, 1.0, " s"),
    ]


def said(server: Server, event: str, place: str) -> float | None:
    """When the log says an event of a job (s); None while it does not."""
    job = place.rsplit("/", 1)[1]
    entries = [json.loads(line) for line in server.log.read_text().splitlines() if f'"{event}"' in line]
    found = [entry["timestamp"] for entry in entries if entry["job"] == job]
    return datetime.fromisoformat(found[0]).timestamp() if found else None


def begin_ensemble(client: httpx.Client) -> str:
    """Address of a new job that reconstructs with an ensemble, so fine that it takes seconds on a fast machine too."""
    files = {"mask": ("mask.nii.gz", MASK.read_bytes())}
    form = {"model": "hippocampus", "uncertainty": "ensemble", "resolution_mm": "0.4"}
    answer = client.post("/v1/reconstructions", files=files, data=form, headers={"Prefer": "respond-async"})
    return str(answer.raise_for_status().headers["location"])


def wait_for(condition: Callable[[], bool], limit_s: float) -> None:
    """Until something holds, but no longer than so."""
    limit = time.monotonic() + limit_s
    while not condition() and time.monotonic() < limit:
        time.sleep(0.05)


def begin_job(client: httpx.Client, count: int) -> str:
    """Address of a new job that draws shapes."""
    parts = {"kind": (None, "samples"), "count": (None, str(count)), "model": (None, "hippocampus")}
    return str(client.post("/v1/jobs", files=parts).raise_for_status().headers["location"])


def run_job(client: httpx.Client, count: int) -> None:
    """The same, to its end."""
    place = begin_job(client, count)
    while client.get(place).json()["state"] in ("queued", "running"):
        time.sleep(0.2)


if __name__ == "__main__":
    typer.run(main)
