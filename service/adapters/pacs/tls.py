"""TLS of DIMSE associations: both sides show a certificate (BCP 195 profile, PS3.15, B.9)."""

import ssl

from service.adapters.pacs.configuration import Tls


def client_context(tls: Tls) -> ssl.SSLContext:
    """For associations that the service asks for."""
    context = ssl.create_default_context(ssl.Purpose.SERVER_AUTH, cafile=str(tls.authorities))
    return _with_certificate(context, tls)


def server_context(tls: Tls) -> ssl.SSLContext:
    """For associations that the service accepts: no certificate, no association."""
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=str(tls.authorities))
    context.verify_mode = ssl.CERT_REQUIRED
    return _with_certificate(context, tls)


def _with_certificate(context: ssl.SSLContext, tls: Tls) -> ssl.SSLContext:
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_cert_chain(tls.certificate, tls.key)
    return context
