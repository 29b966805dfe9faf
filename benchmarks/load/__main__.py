"""All measurements of load, faults and archives, one after the other, in one table.

    python -m benchmarks.load all
    python -m benchmarks.load all --only requests,jobs --quick

What is done stands in a file and is not done again, so that an interrupted run goes on where it stopped. The figures
are those of a machine that does nothing else.
"""

import json
import os
import platform
import time
import traceback
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from benchmarks.load import faults, jobs, kills, memory, replicas, requests
from benchmarks.load.figures import Figure, say
from benchmarks.pacs import scene, storm
from benchmarks.pacs.orthanc import BY_DICOMWEB, BY_DIMSE

Measure = Callable[[], list[Figure]]

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, help=__doc__)


@app.callback()
def _group() -> None:
    """Measurements of load and faults."""


@app.command("all")
def run_all(
    output: Annotated[Path, typer.Option(help="File of figures; what stands in it is not measured again.")] = Path(
        "build/load.json"
    ),
    only: Annotated[str, typer.Option(help="Measurements by name, separated by commas.")] = "",
    quick: Annotated[bool, typer.Option("--quick", help="A tenth of the size: whether all works, no figures.")] = False,
    postgres: Annotated[str, typer.Option(help="Server on which a database may be made; none when empty.")] = (
        "postgresql://postgres@127.0.0.1:5432"
    ),
) -> None:
    """Measure what is not measured yet, and print all of it."""
    chosen = measurements(quick=quick, postgres=postgres)
    names = [name for name in only.split(",") if name] or list(chosen)
    if unknown := set(names) - set(chosen):
        raise typer.BadParameter(f"{', '.join(sorted(unknown))}: known are {', '.join(chosen)}")
    found = json.loads(output.read_text()) if output.exists() else {}
    for name in names:
        if name not in found:
            found |= measured(name, chosen[name])
            output.parent.mkdir(parents=True, exist_ok=True)
            output.write_text(json.dumps(found, indent=1))
    if not shown({name: found[name] for name in names if name in found}) or not found.keys() >= set(names):
        raise typer.Exit(1)


def measurements(*, quick: bool, postgres: str) -> Mapping[str, Measure]:
    """By name, in their order."""
    cores = len(os.sched_getaffinity(0))
    part = 0.1 if quick else 1.0
    span_s = 10.0 if quick else 60.0
    found: dict[str, Measure] = {
        "scene": partial(scene.measure, Path("build/pacs"), BY_DIMSE),
        "scene-dicomweb": partial(scene.measure, Path("build/pacs"), BY_DICOMWEB),
        "requests": partial(requests.measure, span_s, cores),
        "scaling": partial(jobs.scaling, 40 if quick else 400),
        "background": partial(jobs.cost, span_s),
        "cancelling": jobs.cancelling,
        "kills": partial(kills.measure, int(2000 * part), 2 if quick else 10, cores),
        "faults": faults.measure,
        "memory": partial(memory.measure, int(5000 * part), span_s / 2),
        "storm": partial(storm.measure, Path("build/storm"), 20 if quick else 500, 2 if quick else 10),
    }
    if postgres:
        found["replicas"] = partial(replicas.measure, postgres, 9, 8 if quick else 16)
    return found


def measured(name: str, measure: Measure) -> dict[str, dict[str, Any]]:
    """One measurement as a record by its name; nothing when it broke off, so that the next run tries it again."""
    typer.echo(f"-- {name}, begun {datetime.now(UTC):%H:%M:%S}")
    began = time.monotonic()
    try:
        figures = measure()
    except (Exception, SystemExit):  # noqa: BLE001 - the others are to be measured all the same
        typer.echo(f"{name} broke off:\n{traceback.format_exc()}", err=True)
        return {}
    say(figures)
    record = {
        "when": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "seconds": round(time.monotonic() - began, 1),
        "figures": [figure.record() for figure in figures],
    }
    return {name: record}


def shown(found: Mapping[str, Mapping[str, Any]]) -> bool:
    """Print the table; whether everything is reached."""
    table = Table("measurement", "figure", "value", "to reach", "")
    reached = True
    for name, record in found.items():
        for place, entry in enumerate(record["figures"]):
            figure = Figure(**entry)
            first = f"{name} ({record['seconds']:.0f} s)" if place == 0 else ""
            table.add_row(first, figure.name, figure.value, figure.target, figure.verdict)
            reached = reached and figure.reached is not False
    Console().print(table)
    return reached


if __name__ == "__main__":
    app()
