"""How far a process stands back behind others."""

import os
from contextlib import suppress
from pathlib import Path

#: Linux schedules sessions against each other by this value (sched(7), "The autogroup feature"): without it the nice
#: value of a process that leads a session of its own weighs nothing against the rest of the machine.
AUTOGROUP = Path("/proc/self/autogroup")


def stand_back(nice: int, autogroup: Path = AUTOGROUP) -> int:
    """Give way to other processes (0 to 19) on any system, and to other sessions on Linux; returns the nice value.

    A session that others lead is left as it is: the service whose requests come first may be in it.
    """
    reached = os.nice(nice)
    if os.getsid(0) == os.getpid():
        with suppress(OSError):
            autogroup.write_text(str(reached), encoding="ascii")
    return reached
