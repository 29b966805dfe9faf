"""Work that survives a restart: what a kind of job is, what a running one may do, who keeps them and their files."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Any, BinaryIO, Protocol

from model.interruption import Check, unchecked
from service.errors import Kind

__all__ = [
    "BlobStore",
    "Check",
    "JobEngine",
    "JobKind",
    "JobRun",
    "JobState",
    "JobStatus",
    "Record",
]

#: JSON values: names, numbers, keys of files and digests. Arrays and images lie in a `BlobStore`, never here.
Record = Mapping[str, Any]


class JobState(StrEnum):
    """Where a job stands; the last three are final."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def is_final(self) -> bool:
        """Whether nothing will change any more."""
        return self in (JobState.DONE, JobState.FAILED, JobState.CANCELLED)


@dataclass(frozen=True)
class JobStatus:
    """What is known of a job.

    Attributes:
        id: random, or a pure function of kind and idempotency key.
        done, total: items; the total is 0 until it is known.
        problem: sentence that says why it failed.
        problem_kind: of that problem; None where there is none, or its kind is not known.
        result: what the kind's `follow` returned, when it is done.
    """

    id: str
    kind: str
    state: JobState
    argument: Record
    created: datetime
    started: datetime | None
    finished: datetime | None
    done: int
    total: int
    problem: str | None = None
    problem_kind: Kind | None = None
    result: Record | None = None

    def remaining_s(self, now: datetime) -> float | None:
        """Estimated time (s) to its end, from the items done since it started; None while nothing is known."""
        if self.state.is_final:
            return 0.0
        if self.started is None or not 0 < self.done <= self.total:
            return None
        return (now - self.started).total_seconds() * (self.total - self.done) / self.done


class JobRun(Protocol):
    """What a running job may do. Each call is remembered: a job that starts again goes on after the last one."""

    @property
    def id(self) -> str:
        """The job's identifier."""
        ...

    def step(self, name: str, work: Callable[[], Record]) -> Record:
        """Short work that is done once, in the process that follows the job."""
        ...

    def wait(self, seconds: float) -> None:
        """Let time pass; after a restart, what is left of it."""
        ...

    def spread(self, part: str, items: Sequence[Record], sizes: Sequence[int] | None = None) -> list[Record]:
        """Have a part done for each item by whichever worker is free; the answers in the order of the items.

        Args:
            part: a name in the kind's `parts`.
            items: one checkpoint each: what a killed worker had begun of one is done again.
            sizes: how many of the job's items each one counts for; 1 when None.
        """
        ...

    def expect(self, total: int) -> None:
        """How many items the job has."""
        ...


@dataclass(frozen=True)
class JobKind:
    """One kind of job.

    Attributes:
        follow: the course of a job with its argument. Run again from the start after a restart, with every answer of
            `JobRun` remembered, so it must do the same each time: no clock, no randomness, no files but in steps.
        parts: the work itself. Idempotent: the same item leads to the same files and the same answer. Its check raises
            `Cancelled` once nobody wants the job any more; call it between items, or give it to what takes long.
        forget: removes what parts of a job have made; called when one ends after its job was deleted.
    """

    name: str
    follow: Callable[[JobRun, Record], Record]
    parts: Mapping[str, Callable[[Record, Check], Record]]
    forget: Callable[[str], None] = lambda _: None


class JobEngine(Protocol):
    """Keeps jobs; workers in other processes do them."""

    def new_id(self, kind: str, key: str | None = None) -> str:
        """Identifier for a job to come: random, or the same for the same idempotency key."""
        ...

    def enqueue(self, kind: str, argument: Record, identifier: str) -> JobStatus:
        """Have a job done; one that is there under the identifier is left as it is."""
        ...

    def status(self, identifier: str) -> JobStatus:
        """What is known of a job; `UnknownJob` when there is none."""
        ...

    def cancel(self, identifier: str) -> JobStatus:
        """Stop a job; one that has ended stays as it is. `UnknownJob` when there is none."""
        ...

    def forget(self, identifier: str) -> None:
        """Remove the record of a job that has ended; nothing when it is not there."""
        ...

    def known(self, identifiers: Collection[str]) -> set[str]:
        """Those of the identifiers that a job has."""
        ...

    def ended_before(self, moment: datetime) -> Iterator[str]:
        """Identifiers of the jobs that ended before a moment."""
        ...

    def unfinished(self) -> int:
        """Jobs that wait or run, less those that wait for archives."""
        ...

    def backlog(self) -> int:
        """Parts that wait for a worker: what more workers would shorten."""
        ...

    def close(self) -> None:
        """Let go of the database."""
        ...


class BlobStore(Protocol):
    """Files by key (``a/b/c``); written whole or not at all. Failures of the medium are `OSError`."""

    def put(self, key: str, data: bytes) -> None:
        """Write a file, over an older one."""
        ...

    def put_file(self, key: str, file: BinaryIO) -> None:
        """Write a copy of an open file from its beginning, never all of it in memory; may close the file."""
        ...

    def get(self, key: str) -> bytes:
        """Content of a file; `FileNotFoundError` when it is not there."""
        ...

    def exists(self, key: str) -> bool:
        """Whether a file is there."""
        ...

    def list(self, prefix: str) -> Iterable[str]:
        """Keys below a folder (``a/b/``), in no order."""
        ...

    def folders(self, prefix: str) -> Iterable[str]:
        """Names of the folders in a folder (``a/``), in no order."""
        ...

    def delete(self, prefix: str, check: Check = unchecked) -> None:
        """Remove everything below a folder; what the check raises before a piece of it leaves the rest there."""
        ...
