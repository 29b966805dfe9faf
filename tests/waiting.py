"""Waiting for a state that others bring about."""

import time
from collections.abc import Callable


def until(holds: Callable[[], object], within_s: float = 60.0) -> None:
    """Wait until something holds; fails when it never does."""
    limit = time.monotonic() + within_s
    while not holds() and time.monotonic() < limit:
        time.sleep(0.05)
    assert holds()
