"""How long a client waits for the first byte of a batch from a running service."""

import time
from pathlib import Path

from benchmarks.server import serving


def first_byte_s(bundle: Path, name: str) -> float:
    """Seconds from the request of 16 shapes to the first byte of the ZIP, after one shape was made before."""
    with serving((bundle,), {"MORPHOFLOW_SHIPPED_MODELS": "false"}) as server:
        place = f"/v1/models/{name}/samples"
        server.client.get(f"{place}/0").raise_for_status()
        begun = time.perf_counter()
        with server.client.stream("GET", place, params={"count": 16, "seed": 1}) as answer:
            answer.raise_for_status()
            next(answer.iter_raw(1))
            return time.perf_counter() - begun
