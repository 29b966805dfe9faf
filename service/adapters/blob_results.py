"""Results in a `BlobStore`, for several machines over one storage: the files of `archive`, and a marker of expiry."""

import json
import tempfile
import time
import uuid
import zipfile
from collections.abc import Callable
from pathlib import Path

from service.adapters.archive import MESH, STATE, SUMMARY, read_document, read_outcome, write_outcome
from service.adapters.result_store import moment, unknown_result
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
        return StoredResult(name, moment(now), moment(times["expires"]), outcome)

    def load(self, identifier: str) -> StoredResult:
        """A result that has not expired; `UnknownResult` otherwise."""
        name = _checked(identifier)
        with tempfile.TemporaryDirectory() as folder:
            try:
                for file in (SUMMARY, STATE, MESH):
                    (Path(folder) / file).write_bytes(self._blobs.get(f"results/{name}/{file}"))
                document = read_document(Path(folder))
                if document["expires"] <= self._clock():
                    raise unknown_result()
                outcome = read_outcome(Path(folder), document)
            except (FileNotFoundError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
                raise unknown_result() from None
        return StoredResult(name, moment(document["created"]), moment(document["expires"]), outcome)

    def delete(self, identifier: str) -> None:
        """Forget a result; `UnknownResult` when it is not there or has expired."""
        self._blobs.delete(f"results/{self.load(identifier).id}/")

    def sweep(self) -> int:
        """Remove expired results; how many."""
        due: dict[str, list[str]] = {}
        for key in list(self._blobs.list("expiry/")):
            _, time_s, name = key.split("/")
            if float(time_s) <= self._clock():
                due.setdefault(time_s, []).append(name)
        count = 0
        for time_s, names in due.items():
            gone = [name for name in names if self._expiry(name) <= self._clock()]
            for name in gone:
                self._blobs.delete(f"results/{name}/")
            self._blobs.delete(f"expiry/{time_s}/")
            count += len(gone)
        return count

    def _expiry(self, name: str) -> float:
        """Until when a result is served; one that was saved again has a later marker as well."""
        try:
            return float(json.loads(self._blobs.get(f"results/{name}/{SUMMARY}"))["expires"])
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return float("-inf")


def _checked(identifier: str) -> str:
    try:
        return str(uuid.UUID(identifier))
    except ValueError:
        raise unknown_result() from None
