"""Sockets of associations that wait neither to send nor to acknowledge.

A DIMSE message is several short segments. Where the sender gathers short segments (Nagle's algorithm, RFC 896) and the
receiver delays acknowledgements (RFC 1122, 4.2.3.2), each message waits for 40 ms, and a retrieval of 32 images for two
seconds. Either side can end this alone: here segments are sent at once, and acknowledged at once.
"""

import socket
from contextlib import suppress
from typing import Any

from pynetdicom import evt

#: Linux's option for acknowledging at once; it wears off, so it is set anew before each read.
_QUICK_ACK: int | None = getattr(socket, "TCP_QUICKACK", None)


class _PromptSocket(socket.socket):
    def recv(self, size: int, flags: int = 0, /) -> bytes:
        """As its parent, but what came is acknowledged at once."""
        if _QUICK_ACK is not None:
            self.setsockopt(socket.IPPROTO_TCP, _QUICK_ACK, 1)
        return super().recv(size, flags)

    def shutdown(self, how: int, /) -> None:
        """As its parent, but a peer that has left is no error: who shuts down closes next, and must come to that."""
        with suppress(OSError):
            super().shutdown(how)


def _opened(event: Any) -> None:
    """Put a prompt socket in place of the association's; sockets of TLS keep their own class."""
    holder = event.assoc.dul.socket
    plain: socket.socket = holder.socket
    plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if type(plain) is socket.socket:
        timeout_s = plain.gettimeout()
        holder.socket = _PromptSocket(plain.family, plain.type, plain.proto, fileno=plain.detach())
        holder.socket.settimeout(timeout_s)


#: Handler of pynetdicom's events, for those who ask for associations and those who accept them.
PROMPT: tuple[Any, Any] = (evt.EVT_CONN_OPEN, _opened)
