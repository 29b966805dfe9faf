"""A job whose workers are killed again and again: everything is delivered, nothing twice, little is done again.

python -m benchmarks.load.kills --count 2000 --kills 10
"""

import io
import json
import os
import random
import signal
import time
import zipfile
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.load.figures import Figure, at_most, holds, say, told
from benchmarks.load.jobs import begin_job
from benchmarks.server import Server, serving


def main(
    count: Annotated[int, typer.Option(min=10, help="Shapes of the job.")] = 2000,
    kills: Annotated[int, typer.Option(min=1, help="How often a worker is killed (SIGKILL).")] = 10,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes.")] = 2,
) -> None:
    """Kill workers in the middle of a job."""
    say(measure(count, kills, workers))


def measure(count: int, kills: int, workers: int) -> list[Figure]:
    """What a job delivers whose workers are killed."""
    settings = {"MORPHOFLOW_JOB_WORKERS": str(workers), "MORPHOFLOW_LOG_LEVEL": "debug", "MORPHOFLOW_JOB_NICE": "5"}
    with serving((), settings) as server:
        place = begin_job(server.client, count)
        began = time.monotonic()
        killed = 0
        while (job := server.client.get(place).json())["state"] in ("queued", "running"):
            if killed < kills and job["done"] > (killed + 0.5) * count / (kills + 1):
                killed += kill_one(server)
                typer.echo(f"{killed} killed, {job['done']} of {count} shapes done")
            time.sleep(0.1)
        archive = zipfile.ZipFile(io.BytesIO(server.client.get(f"{place}/result").content))
        begun = items_begun(server.log)
        seconds = time.monotonic() - began
    manifest = json.loads(archive.read("manifest.json"))["samples"]
    names = [name for name in archive.namelist() if name != "manifest.json"]
    missing = set(range(count)) - {entry["seed"] for entry in manifest}
    twice = len(names) - len(set(names))
    return [
        holds("workers killed", str(killed), f"{kills}", reached=killed == kills),
        told("the job", f"is {job['state']} after {seconds:.0f} s"),
        holds("shapes missing", f"{len(missing)} of {count}", "none", reached=not missing),
        holds("shapes delivered twice", str(twice), "none", reached=not twice),
        at_most("work done again", 100.0 * (begun - count) / count, 5.0, " %"),
    ]


def kill_one(server: Server) -> int:
    """Kill one of the worker processes; how many were killed."""
    workers = [pid for pid in server.family() if b"worker" in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")]
    if not workers:
        return 0
    os.kill(random.choice(workers), signal.SIGKILL)
    return 1


def items_begun(log: Path) -> int:
    """How often a worker has begun an item, by its log."""
    return sum('"item begun"' in line for line in log.read_text(errors="replace").splitlines())


if __name__ == "__main__":
    typer.run(main)
