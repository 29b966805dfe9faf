"""The largest resident memory of this process during a piece of work."""

import re
import resource
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def with_peak(work: Callable[[], T]) -> tuple[T, float]:
    """The result of a piece of work and the peak meanwhile (MiB).

    Linux alone can reset its high-water mark; elsewhere the peak is that of the process's life so far.
    """
    if _RESET.exists():
        _RESET.write_text("5")
    result = work()
    return result, _peak_mib()


def _peak_mib() -> float:
    if _STATUS.exists():
        found = re.search(r"VmHWM:\s+(\d+) kB", _STATUS.read_text())
        if found:
            return int(found[1]) / 1024.0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 1024.0
