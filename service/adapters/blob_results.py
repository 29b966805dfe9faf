"""Results in a `BlobStore`, for several machines over one storage: the files of `archive`, and a marker of expiry."""

import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import ceil
from pathlib import Path

from service.adapters.archive import MESH, STATE, SUMMARY, moment, parse_document, write_outcome
from service.adapters.kept_results import ResultReader, checked, unknown_result
from service.errors import Overloaded, StoreFull
from service.identifiers import is_identifier
from service.job_ports import BlobStore
from service.observability import Log
from service.ports import Outcome, StoredResult

_GONE = float("-inf")


class BlobResultStore:
    """The `ResultStore` on a `BlobStore`. Its size is bounded by the storage's quota, not here.

    Args:
        lifetime_s: how long a result is served.
        clock: seconds since 1970.
        log: where damage is told; standard error when None.
    """

    def __init__(
        self, blobs: BlobStore, *, lifetime_s: float, clock: Callable[[], float] = time.time, log: Log | None = None
    ) -> None:
        self._blobs = blobs
        self._lifetime_s = lifetime_s
        self._clock = clock
        self._reader = ResultReader(clock, log)

    def save(self, outcome: Outcome, identifier: str | None = None) -> StoredResult:
        """Keep an outcome; `StoreFull` when the storage does not take it.

        The summary is written last, so a result with one is whole.
        """
        name, now = identifier or str(uuid.uuid4()), self._clock()
        times = {"created": now, "expires": now + self._lifetime_s}
        try:
            self._write(name, outcome, times)
        except OSError as fault:
            raise StoreFull("The storage does not take the result now; send the request again later.") from fault
        return StoredResult(name, moment(now), moment(times["expires"]), outcome)

    def load(self, identifier: str) -> StoredResult:
        """A result that has not expired; `UnknownResult` otherwise."""
        name = checked(identifier)
        with tempfile.TemporaryDirectory() as folder:
            try:
                with _answering():
                    self._fetch(name, Path(folder))
            except FileNotFoundError:
                raise unknown_result() from None
            return self._reader.read(name, Path(folder))

    def has(self, identifier: str) -> bool:
        """Whether a result is there and has not expired."""
        with _answering():
            return is_identifier(identifier) and self._expiry(identifier) > self._clock()

    def delete(self, identifier: str) -> None:
        """Forget a result; `UnknownResult` when it is not there or has expired."""
        if not self.has(checked(identifier)):
            raise unknown_result()
        with _answering():
            self._blobs.delete(f"results/{identifier}/")

    def sweep(self) -> int:
        """Remove expired results; how many. What is no marker of one is left alone."""
        due: dict[str, list[str]] = {}
        for key in list(self._blobs.list("expiry/")):
            time_s, _, name = key.removeprefix("expiry/").partition("/")
            if time_s.isdecimal() and is_identifier(name) and float(time_s) <= self._clock():
                due.setdefault(time_s, []).append(name)
        return sum(self._remove_due(time_s, names) for time_s, names in due.items())

    def _remove_due(self, time_s: str, names: list[str]) -> int:
        gone = [name for name in names if self._expiry(name) <= self._clock()]
        for name in gone:
            self._blobs.delete(f"results/{name}/")
        self._blobs.delete(f"expiry/{time_s}/")
        return len(gone)

    def _write(self, name: str, outcome: Outcome, times: dict[str, float]) -> None:
        with tempfile.TemporaryDirectory() as folder:
            write_outcome(Path(folder), outcome, times)
            self._blobs.put(f"expiry/{ceil(times['expires']):012d}/{name}", b"")
            for file in (STATE, MESH, SUMMARY):
                with (Path(folder) / file).open("rb") as content:
                    self._blobs.put_file(f"results/{name}/{file}", content)

    def _fetch(self, name: str, folder: Path) -> None:
        """Copy the files of a result; `FileNotFoundError` when one is not there."""
        for file in (SUMMARY, STATE, MESH):
            (folder / file).write_bytes(self._blobs.get(f"results/{name}/{file}"))

    def _expiry(self, name: str) -> float:
        """Until when a result is served; one that was saved again has a later marker as well."""
        try:
            return float(parse_document(self._blobs.get(f"results/{name}/{SUMMARY}"))["expires"])
        except FileNotFoundError:
            return _GONE
        except ValueError as fault:
            self._reader.tell(name, fault)
            return _GONE


@contextmanager
def _answering() -> Iterator[None]:
    """Storage that is away is work that cannot be taken now."""
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as fault:
        raise Overloaded("Results cannot be read now; send the request again later.") from fault
