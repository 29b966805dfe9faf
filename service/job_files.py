"""Where the files of a job lie in a `BlobStore`: its inputs, and its items, each complete or not there."""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, BinaryIO

from model.interruption import Check, unchecked
from service.errors import UnknownResult
from service.job_ports import BlobStore, Record
from service.ports import ResultStore

_ROOT = "jobs"


def jobs_with_files(blobs: BlobStore) -> Iterable[str]:
    """Identifiers of the jobs that have any."""
    return blobs.folders(f"{_ROOT}/")


def remove_job(blobs: BlobStore, results: ResultStore, job: str) -> None:
    """Forget the files of a job, and the result of a single reconstruction, which has the job's identifier."""
    JobFiles(blobs, job).remove()
    with suppress(UnknownResult):
        results.delete(job)


class JobFiles:
    """The files of one job.

    An item is some files and one entry for the manifest; the entry is written last, so an item with an entry is whole.
    """

    def __init__(self, blobs: BlobStore, job: str) -> None:
        self._blobs = blobs
        self._root = f"{_ROOT}/{job}"

    def put_input(self, number: int, content: bytes | BinaryIO, submission: str = "") -> None:
        """Keep what the caller sent.

        Args:
            content: a file is read from its beginning and may be closed by this.
            submission: name of this attempt where several may want to make the same job; each keeps its own.
        """
        key = self._input(number, submission)
        if isinstance(content, bytes):
            self._blobs.put(key, content)
        else:
            self._blobs.put_file(key, content)

    def input(self, number: int, submission: str = "") -> bytes:
        """What the caller sent."""
        return self._blobs.get(self._input(number, submission))

    def remove_inputs(self, submission: str = "") -> None:
        """Forget what one attempt has kept."""
        self._blobs.delete(f"{self._inputs(submission)}/")

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

    def remove(self, check: Check = unchecked) -> None:
        """Forget all of it; what the check raises ends that early, and it can be gone on with."""
        self._blobs.delete(f"{self._root}/", check)

    def _input(self, number: int, submission: str) -> str:
        return f"{self._inputs(submission)}/{number:08d}"

    def _inputs(self, submission: str) -> str:
        return f"{self._root}/inputs/{submission}".rstrip("/")

    def _key(self, folder: str, number: int) -> str:
        return f"{self._root}/{folder}/{number:08d}"

    def _note(self, name: str) -> str:
        return f"{self._root}/notes/{name}.json"
