"""Three replicas on one PostgreSQL, one of them killed for good: its jobs end elsewhere.

python -m benchmarks.load.replicas --postgres postgresql://postgres@127.0.0.1:5432
"""

import os
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import psycopg
import typer

from benchmarks.load.figures import Figure, at_most, holds, say, told
from service.adapters.jobs.client import DbosJobs
from service.ports import SAMPLES_JOB

_WORKER = "import sys; from service.cli import main; sys.exit(main(['worker']))"


def main(
    postgres: Annotated[str, typer.Option(help="Server on which a database may be made.")],
    jobs: Annotated[int, typer.Option(min=3, help="Jobs at the same time.")] = 9,
    count: Annotated[int, typer.Option(min=4, help="Shapes of each job.")] = 16,
) -> None:
    """Kill one of three replicas while all have work."""
    say(measure(postgres, jobs, count))


def measure(postgres: str, jobs: int, count: int) -> list[Figure]:
    """How soon the others take over."""
    with database(postgres) as url, tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        replicas = {name: stack.enter_context(replica(name, url, Path(folder))) for name in ("a", "b", "c")}
        engine = DbosJobs(url)
        stack.callback(engine.close)
        while engine.workers(10.0) < len(replicas):
            time.sleep(0.1)
        places = [begin(engine, number, count) for number in range(jobs)]
        with psycopg.connect(url, autocommit=True) as connection:
            while len(held := held_by(connection)) < len(replicas):
                time.sleep(0.02)
            victim = max(held, key=lambda name: len(held[name]))
            replicas[victim.rsplit("-", 1)[0]].kill()
            killed, orphans = time.monotonic(), held[victim]
            taken_s = waited(lambda: not held_by(connection).get(victim), killed)
        done_s = waited(
            lambda: all(engine.status(job).state.is_final for job in {one.split("/")[0] for one in orphans}), killed
        )
        waited(lambda: all(engine.status(job).state.is_final for job in places), killed)
        states = [engine.status(job).state.value for job in places]
    finished = states.count("done")
    return [
        told("the killed replica's jobs and parts", f"{len(orphans)}, taken over after {taken_s:.1f} s"),
        at_most("its jobs had ended elsewhere after", done_s, 30.0, " s", 1),
        holds("jobs done", f"{finished} of {jobs}", "all", reached=finished == jobs),
    ]


@contextmanager
def database(postgres: str) -> Iterator[str]:
    """Address of a new database, dropped afterwards."""
    name = f"load_{uuid.uuid4().hex}"
    with psycopg.connect(f"{postgres}/postgres", autocommit=True) as connection:
        connection.execute(f"CREATE DATABASE {name}".encode())
        try:
            yield f"{postgres}/{name}"
        finally:
            connection.execute(f"DROP DATABASE {name} WITH (FORCE)".encode())


@contextmanager
def replica(name: str, url: str, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A worker that shares database and folder with the others."""
    environment = {
        **os.environ,
        "MORPHOFLOW_REPLICA": name,
        "MORPHOFLOW_JOBS_DATABASE": url,
        "MORPHOFLOW_RESULTS_FOLDER": str(folder / "results"),
        "MORPHOFLOW_LOG_LEVEL": "warning",
        "MORPHOFLOW_JOB_NICE": "5",
    }
    with subprocess.Popen([sys.executable, "-c", _WORKER], env=environment) as process:
        try:
            yield process
        finally:
            process.terminate()


def begin(engine: DbosJobs, number: int, count: int) -> str:
    """Identifier of a new job that draws shapes."""
    argument = {
        "model": "hippocampus",
        "count": count,
        "seed": 1000 * number,
        "format": "stl",
        "temperature": 1.0,
        "spacing_mm": None,
    }
    return engine.enqueue(SAMPLES_JOB, argument, engine.new_id(SAMPLES_JOB)).id


def held_by(connection: psycopg.Connection) -> dict[str, list[str]]:
    """Jobs and parts that run, by executor."""
    rows = connection.execute("SELECT executor_id, workflow_uuid FROM dbos.workflow_status WHERE status = 'PENDING'")
    held: dict[str, list[str]] = {}
    for executor, workflow in rows.fetchall():
        held.setdefault(executor, []).append(workflow)
    return held


def waited(condition: object, since: float, limit_s: float = 300.0) -> float:
    """Seconds since a moment until something holds."""
    while not condition() and time.monotonic() - since < limit_s:  # type: ignore[operator]
        time.sleep(0.1)
    return time.monotonic() - since


if __name__ == "__main__":
    typer.run(main)
