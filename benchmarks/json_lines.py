"""Files of JSON lines that a run adds to and goes on from."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any


def read_lines(path: Path) -> Iterator[Any]:
    """The values in a file, none where there is no file; a line that a kill cut short is passed over."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    for line in lines:
        try:
            yield json.loads(line)
        except ValueError:
            continue


def append_lines(path: Path, values: Iterable[object]) -> None:
    """Add values, on lines of their own even where the last one was cut short."""
    path.parent.mkdir(parents=True, exist_ok=True)
    whole = not path.is_file() or path.read_bytes()[-1:] in (b"", b"\n")
    with path.open("a", encoding="utf-8") as stream:
        stream.write("" if whole else "\n")
        stream.writelines(json.dumps(value) + "\n" for value in values)
