"""Jobs: what a second worker adds, and what a job in the background costs the requests that somebody waits for.

python -m benchmarks.load.jobs --count 400
"""

import json
import time
from datetime import datetime
from typing import Annotated

import httpx
import typer

from benchmarks.load.traffic import send
from benchmarks.server import serving


def main(
    count: Annotated[int, typer.Option(min=16, help="Shapes of the jobs.")] = 400,
    duration_s: Annotated[float, typer.Option(min=5.0, help="Of each of the runs of requests.")] = 40.0,
) -> None:
    """Scaling of jobs, and their cost for requests."""
    one, two = (job_rate(workers, count) for workers in (1, 2))
    print(f"one worker      {one:8.2f} shapes a second")
    print(f"two workers     {two:8.2f} shapes a second; ratio {two / one:.2f} (to reach: 1.80)")
    alone_s, beside_s = background(duration_s)
    print(f"median alone    {alone_s:8.3f} s")
    print(f"beside a job    {beside_s:8.3f} s; ratio {beside_s / alone_s:.2f} (to reach: below 1.25)")
    told_s, last_s = cancelling()
    print(
        f"cancelling      {told_s:8.3f} s until the state says so; last item begun after {max(last_s, 0.0):.2f} s (1 s)"
    )


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


def cancelling() -> tuple[float, float]:
    """Seconds from the request to cancel until its answer, and until the last item was begun."""
    with serving((), {"MORPHOFLOW_JOB_WORKERS": "1", "MORPHOFLOW_LOG_LEVEL": "debug"}) as server:
        place = begin_job(server.client, 5000)
        while not server.client.get(place).json()["done"]:
            time.sleep(0.1)
        asked = time.time()
        state = server.client.delete(place).raise_for_status().json()["state"]
        told_s = time.time() - asked
        time.sleep(5.0)
        entries = [json.loads(line) for line in server.log.read_text().splitlines() if '"item begun"' in line]
    if state != "cancelled":
        raise SystemExit(f"The job was not cancelled: it is {state}.")
    return told_s, max(datetime.fromisoformat(entry["timestamp"]).timestamp() for entry in entries) - asked


def begin_job(client: httpx.Client, count: int) -> str:
    """Address of a new job that draws shapes."""
    parts = {"kind": (None, "samples"), "count": (None, str(count)), "model": (None, "hippocampus")}
    return client.post("/v1/jobs", files=parts).raise_for_status().headers["location"]


def run_job(client: httpx.Client, count: int) -> None:
    """The same, to its end."""
    place = begin_job(client, count)
    while client.get(place).json()["state"] in ("queued", "running"):
        time.sleep(0.2)


if __name__ == "__main__":
    typer.run(main)
