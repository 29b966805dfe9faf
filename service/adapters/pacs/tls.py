"""TLS of DIMSE associations: both sides show a certificate (BCP 195 profile, PS3.15, B.9)."""

import socket
import ssl
from typing import Any

from service.adapters.pacs.configuration import Tls

#: Longest wait for more of what a peer has begun to say (s).
SILENCE_S = 15.0


def client_context(tls: Tls) -> ssl.SSLContext:
    """For associations that the service asks for."""
    context = ssl.create_default_context(ssl.Purpose.SERVER_AUTH, cafile=str(tls.authorities))
    return _with_certificate(context, tls)


def server_context(tls: Tls) -> ssl.SSLContext:
    """For associations that the service accepts: no certificate, no association."""
    context = _LateHandshakes(ssl.PROTOCOL_TLS_SERVER)
    context.load_verify_locations(tls.authorities)
    context.verify_mode = ssl.CERT_REQUIRED
    return _with_certificate(context, tls)


class _LateHandshakes(ssl.SSLContext):
    """Each connection's handshake is made when it is first read, by the thread that reads; the port waits for none."""

    def wrap_socket(self, sock: socket.socket, server_side: bool = False, *_: Any, **__: Any) -> ssl.SSLSocket:
        """As its parent, without a handshake, and with a time limit on each wait for the peer."""
        sock.settimeout(SILENCE_S)
        return super().wrap_socket(sock, server_side, do_handshake_on_connect=False)


def _with_certificate(context: ssl.SSLContext, tls: Tls) -> ssl.SSLContext:
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_cert_chain(tls.certificate, tls.key)
    return context
