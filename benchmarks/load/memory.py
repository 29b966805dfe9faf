"""Memory over thousands of requests: flat, or a leak.

python -m benchmarks.load.memory --requests 5000
"""

import os
from typing import Annotated

import numpy as np
import typer

from benchmarks.load.figures import Figure, at_most, holds, say, told
from benchmarks.load.traffic import send
from benchmarks.server import serving

#: Requests before memory counts: buffers and caches fill.
WARM_UP = 500
#: Growth (MiB) for 1000 requests that counts as none.
FLAT_MIB = 1.0


def main(
    requests: Annotated[int, typer.Option(min=50, help="How many.")] = 5000,
    batch_s: Annotated[float, typer.Option(min=5.0, help="Memory is read after each batch of so many seconds.")] = 20.0,
) -> None:
    """Resident memory of the service while it answers requests of every kind."""
    say(measure(requests, batch_s))


def measure(requests: int, batch_s: float) -> list[Figure]:
    """Memory after each batch, and how it grows."""
    cores = len(os.sched_getaffinity(0))
    counts, sizes, failed = [0], [], 0
    with serving((), {"MORPHOFLOW_WORKERS": str(cores), "MORPHOFLOW_RESULTS_MAX_BYTES": "100000000"}) as server:
        sizes.append(server.memory_mib())
        while counts[-1] < requests:
            batch = send(server, users=2 * cores, duration_s=batch_s, kind="mixed")
            counts.append(counts[-1] + len(batch.seconds))
            sizes.append(server.memory_mib())
            failed += batch.failed
            typer.echo(f"{counts[-1]:6d} requests {sizes[-1]:7.0f} MiB")
    return figures(counts, sizes, failed)


def figures(counts: list[int], sizes: list[float], failed: int) -> list[Figure]:
    """What the sizes (MiB) after so many requests say."""
    warm = [number for number, count in enumerate(counts) if count >= WARM_UP]
    first, last = sizes[warm[0]], sizes[-1]
    found = [
        told(f"memory after {counts[warm[0]]} requests", f"{first:.0f} MiB"),
        told(f"memory after {counts[-1]} requests", f"{last:.0f} MiB"),
        holds("requests that failed", str(failed), "none", reached=not failed),
    ]
    if len(warm) > 2:
        slope = np.polyfit([counts[i] for i in warm], [sizes[i] for i in warm], 1)[0] * 1000.0
        found.append(at_most("growth for 1000 requests", slope, FLAT_MIB, " MiB"))
    return found


if __name__ == "__main__":
    typer.run(main)
