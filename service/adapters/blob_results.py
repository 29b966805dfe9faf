"""Results in a `BlobStore`, for several machines over one storage: the files of `archive`, and a marker of expiry."""

import tempfile
import time
import uuid
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from service.adapters.archive import MESH, STATE, SUMMARY, read_document, read_outcome, write_outcome
from service.errors import UnknownResult
from service.job_ports import BlobStore
from service.ports import Outcome, StoredResult


class BlobResultStore:
    """The `ResultStore` on a `BlobStore`. Its size is bounded by the storage's quota, not here.

    Args:
        lifetime_s: how long a result is served.
        clock: seconds since 1970.
    """

    def __init__(self, blobs: BlobStore, *, lifetime_s: float, clock: Callable[[], float] = time.time) -> None:
        self._blobs = blobs
        self._lifetime_s = lifetime_s
        self._clock = clock

    def save(self, outcome: Outcome, identifier: str | None = None) -> StoredResult:
        """Keep an outcome; the summary is written last, so a result with one is whole."""
        name, now = identifier or str(uuid.uuid4()), self._clock()
        times = {"created": now, "expires": now + self._lifetime_s}
        with tempfile.TemporaryDirectory() as folder:
            write_outcome(Path(folder), outcome, times)
            self._blobs.put(f"expiry/{int(times['expires']):012d}/{name}", b"")
            for file in (STATE, MESH, SUMMARY):
                self._blobs.put_file(f"results/{name}/{file}", Path(folder) / file)
        return StoredResult(name, _moment(now), _moment(times["expires"]), outcome)

    def load(self, identifier: str) -> StoredResult:
        """A result that has not expired; `UnknownResult` otherwise."""
        name = _checked(identifier)
        with tempfile.TemporaryDirectory() as folder:
            try:
                for file in (SUMMARY, STATE, MESH):
                    (Path(folder) / file).write_bytes(self._blobs.get(f"results/{name}/{file}"))
                document = read_document(Path(folder))
                if document["expires"] <= self._clock():
                    raise _unknown()
                outcome = read_outcome(Path(folder), document)
            except (FileNotFoundError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
                raise _unknown() from None
        return StoredResult(name, _moment(document["created"]), _moment(document["expires"]), outcome)

    def delete(self, identifier: str) -> None:
        """Forget a result; `UnknownResult` when it is not there or has expired."""
        self.load(identifier)
        self._blobs.delete(f"results/{identifier}/")

    def sweep(self) -> int:
        """Remove expired results; how many."""
        count = 0
        for key in list(self._blobs.list("expiry/")):
            _, moment, name = key.split("/")
            if float(moment) <= self._clock():
                self._blobs.delete(f"results/{name}/")
                self._blobs.delete(f"expiry/{moment}/")
                count += 1
        return count


def _checked(identifier: str) -> str:
    try:
        return str(uuid.UUID(identifier))
    except ValueError:
        raise _unknown() from None


def _unknown() -> UnknownResult:
    return UnknownResult("There is no reconstruction of this identifier; it may have expired or been deleted.")


def _moment(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)
