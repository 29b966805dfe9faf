"""Application entities that accept associations, each from those alone who are expected."""

from collections.abc import Iterable

from pynetdicom import AE
from pynetdicom.association import Association

#: Time that a connection has for its request (s).
REQUEST_S = 5.0


class ListeningEntity(AE):
    """Counts associations from their request on: connections that say nothing take no place from others.

    Args:
        title: that callers must call.
        callers: titles of those who may associate.
        most: associations at the same time.
    """

    def __init__(self, title: str, callers: Iterable[str], most: int) -> None:
        super().__init__(ae_title=title)
        self.maximum_associations, self.acse_timeout = most, REQUEST_S
        self.require_called_aet = True
        self.require_calling_aet = list(callers)

    @property
    def active_associations(self) -> list[Association]:
        """Those that were asked for."""
        return [found for found in super().active_associations if found.requestor.primitive is not None]
