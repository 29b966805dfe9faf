"""Which parts of the prior a cell has."""

from enum import StrEnum


class PriorName(StrEnum):
    """Which parts of the prior a cell has."""

    FLOW_ARD = "flow-ard"
    FLOW = "flow"
    ARD = "ard"
    PLAIN = "plain"

    @classmethod
    def of(cls, *, flow: bool, ard: bool) -> "PriorName":
        """The name of these parts."""
        return {(True, True): cls.FLOW_ARD, (True, False): cls.FLOW, (False, True): cls.ARD}.get((flow, ard), cls.PLAIN)

    @property
    def flow(self) -> bool:
        """Whether there is a flow."""
        return self in (PriorName.FLOW_ARD, PriorName.FLOW)

    @property
    def ard(self) -> bool:
        """Whether relevance is determined."""
        return self in (PriorName.FLOW_ARD, PriorName.ARD)
