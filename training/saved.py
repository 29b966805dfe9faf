"""Files of a training that goes on later: replaced in one move, and read with a sentence where they are damaged."""

import json
import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from model.errors import InvalidParameter

#: Raised by JSON, by torch and by what takes their values where a file is cut short or of another kind. Beside them are
#: errors of the operating system that name no file.
DAMAGED = (AttributeError, EOFError, KeyError, RuntimeError, TypeError, ValueError, pickle.UnpicklingError)


@contextmanager
def intact(name: str) -> Iterator[None]:
    """Let what a damaged file leads to be one sentence.

    Args:
        name: of the file.

    Raises:
        InvalidParameter: the file is damaged.
    """
    try:
        yield
    except (OSError, *DAMAGED) as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise
        raise InvalidParameter(
            f"The run in the folder cannot be read, since {name} is incomplete or of another kind; a whole copy of it, "
            "or a new run, is accepted.",
            part="run",
        ) from error


def read_state(path: Path, device: torch.device | str, *, mmap: bool = False) -> dict[str, Any]:
    """What `torch.save` wrote, on a device.

    Raises:
        InvalidParameter: the file is damaged.
    """
    with intact(path.name):
        state = torch.load(path, map_location=device, weights_only=True, mmap=mmap)
        return {**state}


def write_json(path: Path, values: object) -> None:
    """Write plain values; a file that was there stays until the new one is whole."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    part.replace(path)
