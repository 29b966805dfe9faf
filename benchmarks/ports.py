"""Ports for servers that are started here."""

import random
import socket
from contextlib import ExitStack

#: Below those that outgoing connections take for their own end (Linux: from 32768), so that none is gone before use.
PORTS = range(20000, 32000)


def free_ports(count: int) -> list[int]:
    """Ports of the loopback interface that nothing listens on."""
    with ExitStack() as held:
        found: list[int] = []
        while len(found) < count:
            probe = held.enter_context(socket.socket())
            try:
                probe.bind(("127.0.0.1", random.choice(PORTS)))
            except OSError:
                continue
            found.append(int(probe.getsockname()[1]))
        return found


def free_port() -> int:
    """One of them."""
    return free_ports(1)[0]
