"""Requests that somebody waits for: throughput beside what the computation alone allows, and latency at 80 % of it.

    python -m benchmarks.load.requests --duration-s 60

The ceiling is what as many processes as there are cores compute without HTTP, measured before and after, since a
machine's speed may change, and less what the sender takes of the same cores; the ratio should be 0.9 or more. At 80 %
of the measured throughput, with users that send at an even pace, the 99th percentile should be less than 3 times the
median; with users that send at random times it is told beside it.
"""

import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Annotated

import typer
from threadpoolctl import threadpool_limits

from benchmarks.load.figures import Figure, at_least, at_most, holds, say, told
from benchmarks.load.traffic import MASK, Traffic, send
from benchmarks.server import serving
from model.inference.reconstruction import Options
from service import use_cases
from service.adapters.mesh_formats import write_mesh
from service.model_registry import load_registry
from service.settings import load_settings
from service.wiring import mask_reader

#: Users at 80 % load; many, so that none of them holds the others up.
USERS = 16


def main(
    duration_s: Annotated[float, typer.Option(min=5.0, help="Of each of the two runs.")] = 60.0,
    cores: Annotated[int, typer.Option(min=1, help="Cores that the service may use.")] = len(os.sched_getaffinity(0)),
    load: Annotated[float, typer.Option(min=0.1, max=1.0, help="Share of the throughput.")] = 0.8,
) -> None:
    """Throughput and latency of reconstructions (without uncertainty)."""
    say(measure(duration_s, cores, load))


def measure(duration_s: float, cores: int, load: float = 0.8) -> list[Figure]:
    """The service under full load, and under a share of it."""
    before = computing_rate(cores, duration_s / 4)
    with serving((), {"MORPHOFLOW_WORKERS": str(cores), "MORPHOFLOW_MAX_WAITING": "64"}) as server:
        send(server, users=cores, duration_s=5.0)
        began = server.cpu_s()
        full = send(server, users=2 * cores, duration_s=duration_s)
        spent_s = (server.cpu_s() - began) / max(len(full.seconds), 1)
        ceiling = (before + computing_rate(cores, duration_s / 4)) / 2
        paced = send(server, users=USERS, rate=load * full.rate, duration_s=duration_s)
        random = send(server, users=USERS, rate=load * full.rate, duration_s=duration_s, by_chance=True)
    left = 1.0 - full.sender_cpu_s / (cores * full.duration_s)
    failed = full.failed + paced.failed + random.failed
    return [
        told("computation alone, a process on each core", f"{ceiling:.2f} a second"),
        told("CPU of the service for one request", f"{spent_s:.3f} s"),
        told("sustained throughput", f"{full.rate:.2f} a second; the sender takes {1.0 - left:.1%} of the cores"),
        at_least("  of what the computation allows on the rest", full.rate / (ceiling * left), 0.9),
        told(f"at {load:.0%} of it", _latency(paced)),
        at_most("  p99 over median", paced.quantile_s(0.99) / paced.quantile_s(0.5), 3.0),
        told("  at random times", _latency(random)),
        holds("requests that failed", str(failed), "none", reached=not failed),
    ]


def _latency(traffic: Traffic) -> str:
    median_s, p99_s = traffic.quantile_s(0.5), traffic.quantile_s(0.99)
    return f"{traffic.rate:.2f} a second; median {median_s:.3f} s, p99 {p99_s:.3f} s"


def computing_rate(processes: int, duration_s: float) -> float:
    """Computations of the request a second, without HTTP, by so many processes of one thread at the same time."""
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        return sum(pool.map(_rate_of_one, [duration_s] * processes))


def _rate_of_one(duration_s: float) -> float:
    """From the file to the surface's file, again and again."""
    threadpool_limits(limits=1, user_api="blas")  # as the service has it
    settings = load_settings({"threads": 1})
    model = load_registry(settings).get("hippocampus")
    read, data = mask_reader(settings), MASK.read_bytes()

    def compute() -> None:
        outcome = use_cases.reconstruct(model, read(data, "mask", None), Options(uncertainty="none"))
        write_mesh(outcome.reconstruction.mesh, "stl", space="RAS", metadata={})

    compute()
    began, count = time.perf_counter(), 0
    while time.perf_counter() - began < duration_s:
        compute()
        count += 1
    return count / (time.perf_counter() - began)


if __name__ == "__main__":
    typer.run(main)
