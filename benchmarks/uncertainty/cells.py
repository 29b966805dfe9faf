"""What was measured, one line of JSON a cell, so that a run that was ended goes on where it stopped."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

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
        if not self.path.is_file():
            return {}
        found = {}
        for line in self.path.read_text(encoding="utf-8").splitlines():
            try:
                values = json.loads(line)
                found[Key(**values["key"])] = dict(values["payload"])
            except (ValueError, KeyError, TypeError):
                continue
        return found

    def append(self, key: Key, payload: Payload) -> None:
        """Add a cell and see it written."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        whole = not self.path.is_file() or self.path.read_bytes()[-1:] in (b"", b"\n")
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write("" if whole else "\n")
            stream.write(json.dumps({"key": asdict(key), "payload": payload}) + "\n")
