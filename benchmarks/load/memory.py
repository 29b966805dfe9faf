"""Memory over thousands of requests: flat, or a leak.

python -m benchmarks.load.memory --requests 5000
"""

import os
from typing import Annotated

import numpy as np
import typer

from benchmarks.load.traffic import send
from benchmarks.server import serving

#: Requests before memory counts: buffers and caches fill.
WARM_UP = 100


def main(
    requests: Annotated[int, typer.Option(min=50, help="How many.")] = 5000,
    batch_s: Annotated[float, typer.Option(min=5.0, help="Memory is read after each batch of so many seconds.")] = 20.0,
) -> None:
    """Resident memory of the service while it answers."""
    cores = len(os.sched_getaffinity(0))
    counts, sizes = [0], []
    with serving((), {"MORPHOFLOW_WORKERS": str(cores), "MORPHOFLOW_RESULTS_MAX_BYTES": "100000000"}) as server:
        sizes.append(server.memory_mib())
        while counts[-1] < requests:
            counts.append(counts[-1] + len(send(server, users=cores, duration_s=batch_s).seconds))
            sizes.append(server.memory_mib())
            print(f"{counts[-1]:6d} requests {sizes[-1]:7.0f} MiB", flush=True)
    warm = [number for number, count in enumerate(counts) if count >= WARM_UP]
    first, last = sizes[warm[0]], sizes[-1]
    slope = np.polyfit([counts[i] for i in warm], [sizes[i] for i in warm], 1)[0] * 1000.0 if len(warm) > 2 else np.nan
    grown = f"from {first:.0f} MiB after {counts[warm[0]]} requests to {last:.0f} MiB after {counts[-1]}"
    print(f"{grown}: {last / first:.3f}")
    print(f"slope {slope:.2f} MiB for 1000 requests (flat: below 1)")


if __name__ == "__main__":
    typer.run(main)
