"""Results on disk: one folder each, complete or not there, with a time to live.

A folder is written under a temporary name and renamed, so a reader or a restart never meets half of
one. Deleting renames first as well. Expired results are never served, even before they are swept.
"""

import os
import shutil
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from service.adapters.archive import moment, read_document, write_outcome
from service.adapters.kept_results import ResultReader, checked, unknown_result
from service.errors import StoreFull
from service.full_disks import is_full
from service.identifiers import is_identifier
from service.observability import Log
from service.ports import Outcome, StoredResult

_TEMPORARY = ".tmp-"
#: A temporary folder older than this (s) belongs to a program that is gone.
_ABANDONED_AFTER_S = 3600.0
#: How often (s) the folder is looked through for results that other processes keep there.
_LOOK_AGAIN_S = 1.0


@dataclass(frozen=True)
class _Kept:
    """Size (bytes) of a result, and until when it is served (seconds since 1970)."""

    size: int
    expires: float


class DiskResultStore:
    """The `ResultStore` on a folder of the file system.

    Args:
        folder: made when it is not there, readable by its owner alone.
        lifetime_s: how long a result is served.
        max_bytes: size of all results together; the oldest make room for a new one. Other processes may keep results
            in the same folder; what they added within the last second may not be counted yet.
        clock: seconds since 1970.
        log: where damage is told; standard error when None.
    """

    def __init__(
        self,
        folder: Path,
        *,
        lifetime_s: float,
        max_bytes: int,
        clock: Callable[[], float] = time.time,
        log: Log | None = None,
    ) -> None:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._folder = folder
        self._lifetime_s = lifetime_s
        self._max_bytes = max_bytes
        self._clock = clock
        self._reader = ResultReader(clock, log)
        self._lock = threading.Lock()
        self._kept: dict[str, _Kept] = {}
        self._looked_at = float("-inf")

    def save(self, outcome: Outcome, identifier: str | None = None) -> StoredResult:
        """Keep an outcome; `StoreFull` when it alone is larger than the store."""
        identifier, now = identifier or str(uuid.uuid4()), self._clock()
        temporary = self._folder / f"{_TEMPORARY}{uuid.uuid4()}"
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            temporary.mkdir(mode=0o700)
            times = {"created": now, "expires": now + self._lifetime_s}
            write_outcome(temporary, outcome, times)
            with self._lock:
                kept = _Kept(_size(temporary), times["expires"])
                self._make_room(kept.size, identifier)
                self._remove(identifier)
                temporary.rename(self._folder / identifier)
                self._kept[identifier] = kept
        except BaseException as fault:
            shutil.rmtree(temporary, ignore_errors=True)
            if is_full(fault):
                raise StoreFull("The disk has no room for the result; send the request again later.") from fault
            raise
        return StoredResult(identifier, moment(now), moment(times["expires"]), outcome)

    def load(self, identifier: str) -> StoredResult:
        """A result that has not expired; `UnknownResult` otherwise."""
        return self._reader.read(identifier, self._folder / checked(identifier))

    def has(self, identifier: str) -> bool:
        """Whether a result is there and has not expired."""
        return is_identifier(identifier) and self._expiry(self._folder / identifier) > self._clock()

    def delete(self, identifier: str) -> None:
        """Forget a result; `UnknownResult` when it is not there or has expired."""
        folder = self._folder / checked(identifier)
        with self._lock:
            expired = self._expiry(folder) <= self._clock()
            if not self._remove(identifier) or expired:
                raise unknown_result()

    def sweep(self) -> int:
        """Remove expired, damaged and half-written results; how many."""
        now = self._clock()
        with self._lock:
            gone = [name for name in self._results() if self._expiry(self._folder / name) <= now]
            for leftover in self._folder.glob(f"{_TEMPORARY}*"):
                if _modified(leftover) < now - _ABANDONED_AFTER_S:
                    shutil.rmtree(leftover, ignore_errors=True)
            return sum(self._remove(name) for name in gone)

    def _results(self) -> list[str]:
        with os.scandir(self._folder) as entries:
            return [entry.name for entry in entries if is_identifier(entry.name)]

    def _expiry(self, folder: Path) -> float:
        try:
            return float(read_document(folder)["expires"])
        except FileNotFoundError:
            return float("-inf")
        except (OSError, ValueError) as fault:
            self._reader.tell(folder.name, fault)
            return float("-inf")

    def _make_room(self, needed: int, replaced: str) -> None:
        if needed > self._max_bytes:
            raise StoreFull("The result is larger than all results that this service may keep together.")
        now = self._clock()
        if abs(now - self._looked_at) >= _LOOK_AGAIN_S:  # a clock may be set back
            # What is kept does not change, so that each folder is read once.
            self._kept = {name: self._kept.get(name) or self._read(name) for name in self._results()}
            self._looked_at = now
        others = {name: kept for name, kept in self._kept.items() if name != replaced}
        while sum(kept.size for kept in others.values()) + needed > self._max_bytes:
            oldest = min(others, key=lambda name: others[name].expires)
            del others[oldest]
            self._remove(oldest)

    def _read(self, name: str) -> "_Kept":
        return _Kept(_size(self._folder / name), self._expiry(self._folder / name))

    def _remove(self, name: str) -> bool:
        grave = self._folder / f"{_TEMPORARY}{uuid.uuid4()}"
        self._kept.pop(name, None)
        try:
            (self._folder / name).rename(grave)
        except OSError:
            return False
        shutil.rmtree(grave, ignore_errors=True)
        return True


def _size(folder: Path) -> int:
    try:
        return sum(file.stat().st_size for file in folder.iterdir())
    except OSError:
        return 0


def _modified(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return float("inf")
