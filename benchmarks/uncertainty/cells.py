"""What was measured, one line of JSON a cell, so that a run that was ended goes on where it stopped."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.json_lines import append_lines, read_lines

#: Figures of one cell, plain numbers and lists.
Payload = dict[str, Any]


@dataclass(frozen=True)
class Key:
    """What makes a measurement the same one.

    Attributes:
        kind: ``answer``, ``next-plane``, ``stranger`` or ``gold``.
        subject: case, and what else was varied.
        regime: how it was drawn.
        digest: of the bundle.
    """

    kind: str
    cohort: str
    subject: str
    regime: str
    digest: str


class Store:
    """JSON lines in the order of measurement; a line cut off by a kill is passed over."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> dict[Key, Payload]:
        """All cells; the last one of equal keys."""
        found = {}
        for values in read_lines(self.path):
            try:
                found[Key(**values["key"])] = dict(values["payload"])
            except (ValueError, KeyError, TypeError):
                continue
        return found

    def append(self, key: Key, payload: Payload) -> None:
        """Add a cell and see it written."""
        append_lines(self.path, [{"key": asdict(key), "payload": payload}])
