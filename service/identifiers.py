"""The one spelling of identifiers of results and jobs: a UUID in lower case, as the service writes it."""

import re

_IDENTIFIER = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}\Z")


def is_identifier(text: str) -> bool:
    """Whether the service may have given this name to something; others need not be looked for."""
    return _IDENTIFIER.match(text) is not None
