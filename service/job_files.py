"""Where the files of a job lie in a `BlobStore`: its inputs, and its items, each complete or not there."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.job_ports import BlobStore, Record


class JobFiles:
    """The files of one job.

    An item is some files and one entry for the manifest; the entry is written last, so an item with an entry is whole.
    """

    def __init__(self, blobs: BlobStore, job: str) -> None:
        self._blobs = blobs
        self._root = f"jobs/{job}"

    def put_input(self, number: int, content: bytes | Path) -> None:
        """Keep what the caller sent."""
        key = self._key("inputs", number)
        if isinstance(content, Path):
            self._blobs.put_file(key, content)
        else:
            self._blobs.put(key, content)

    def input(self, number: int) -> bytes:
        """What the caller sent."""
        return self._blobs.get(self._key("inputs", number))

    def put_item(self, number: int, files: Mapping[str, bytes], entry: Record) -> None:
        """Keep an item; the names of its files are for the reader, the entry's member `files` lists them."""
        for place, data in enumerate(files.values()):
            self._blobs.put(f"{self._key('items', number)}/{place}", data)
        self.put_note(f"{number:08d}", {**entry, "files": list(files)})

    def has_item(self, number: int) -> bool:
        """Whether an item is whole."""
        return self._blobs.exists(self._note(f"{number:08d}"))

    def item(self, number: int) -> tuple[dict[str, bytes], dict[str, Any]]:
        """Files by name, and the entry; `FileNotFoundError` when the item is not whole."""
        entry = self.note(f"{number:08d}")
        names = entry.pop("files")
        return {n: self._blobs.get(f"{self._key('items', number)}/{place}") for place, n in enumerate(names)}, entry

    def put_note(self, name: str, record: Record) -> None:
        """Keep what is too long, or says too much, for the job's record."""
        self._blobs.put(self._note(name), json.dumps(record).encode())

    def note(self, name: str) -> dict[str, Any]:
        """A note; `FileNotFoundError` when it is not there."""
        found: dict[str, Any] = json.loads(self._blobs.get(self._note(name)))
        return found

    def remove(self) -> None:
        """Forget all of it."""
        self._blobs.delete(f"{self._root}/")

    def _key(self, folder: str, number: int) -> str:
        return f"{self._root}/{folder}/{number:08d}"

    def _note(self, name: str) -> str:
        return f"{self._root}/notes/{name}.json"
