"""Jobs as their callers see them: kept in a database, done by workers in other processes (`worker`)."""

import sqlite3
import threading
import uuid
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import sqlalchemy as sa
from dbos import DBOSClient, EnqueueOptions, WorkflowStatus, WorkflowStatusString, error
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as SQLAlchemyTimeout

from service.adapters.jobs.database import (
    APPLICATION,
    CONNECT_S,
    JOB,
    JOBS_QUEUE,
    PARTS_QUEUE,
    RECORDS_VERSION,
    SCHEMA,
    Leases,
    is_postgres,
    json_serializer,
    open_engine,
    prepare,
    queue_of,
)
from service.errors import KINDS, PROTOCOL_KINDS, Kind, Overloaded, StoreFull, UnknownJob
from service.full_disks import is_full
from service.identifiers import is_identifier
from service.job_ports import JobState, JobStatus, Record
from service.observability import Log, make_log

P = ParamSpec("P")
T = TypeVar("T")
#: Connections to PostgreSQL, beside those of the leases.
CONNECTIONS = 3
#: Event of a running job that holds its items: done and total.
PROGRESS = "progress"
_NAMESPACE = uuid.UUID("6d6f7270-686f-5f6c-8f77-6a6f62732d31")
_STATES = {
    WorkflowStatusString.DELAYED.value: JobState.QUEUED,
    WorkflowStatusString.ENQUEUED.value: JobState.QUEUED,
    WorkflowStatusString.PENDING.value: JobState.RUNNING,
    WorkflowStatusString.SUCCESS.value: JobState.DONE,
    WorkflowStatusString.CANCELLED.value: JobState.CANCELLED,
}
#: Jobs of one query.
_ASKED_FOR = 500
_KINDS = {error.__name__: kind for error, kind in KINDS.items()}
_FAULT = "The job met a fault of the service; its logs hold more under the job's identifier."


#: What a database, or the way to it, may raise; the first four say that it is away for now, or has no room.
_AWAY = (OperationalError, InterfaceError, SQLAlchemyTimeout, sqlite3.OperationalError)
FAULTS = (*_AWAY, DBAPIError, sqlite3.Error, error.DBOSException)
#: How PostgreSQL and SQLite say that a disk is full.
_FULL = ("53100", "SQLITE_FULL")


def _answered(method: Callable[Concatenate["DbosJobs", P], T]) -> Callable[Concatenate["DbosJobs", P], T]:
    """A database that is away is work that cannot be taken now, not a wait; any other of its faults is a fault."""

    @wraps(method)
    def tried(jobs: "DbosJobs", /, *arguments: P.args, **named: P.kwargs) -> T:
        try:
            return method(jobs, *arguments, **named)
        except FAULTS as fault:
            cause = _cause(fault)
            jobs.log.warning("jobs' database", kind=type(cause).__name__, state=_state(cause))
            if isinstance(cause, _AWAY):
                raise _away() from fault
            raise

    return tried


def _cause(fault: BaseException) -> BaseException:
    """The database's own fault where DBOS has wrapped it."""
    return fault.__cause__ if isinstance(fault, error.DBOSException) and fault.__cause__ else fault


def _state(fault: BaseException) -> str | None:
    """How the database names its fault (SQLSTATE, or SQLite's name); None where it had no time to."""
    origin = getattr(fault, "orig", None) or fault
    state: str | None = getattr(origin, "sqlstate", None) or getattr(origin, "sqlite_errorname", None)
    return state


def _away() -> Overloaded:
    return Overloaded("The jobs' database does not answer; send the request again later.")


@contextmanager
def _needing_room() -> Iterator[None]:
    """What makes a job takes room in the database."""
    try:
        yield
    except (*FAULTS, OSError) as fault:
        if _state(_cause(fault)) in _FULL or is_full(fault):
            raise StoreFull("The jobs' database has no room for the job; send the request again later.") from fault
        raise


class DbosJobs:
    """The `JobEngine` over DBOS; connects when it is first used.

    Args:
        url: ``sqlite:////folder/file`` or ``postgresql://user@host/database``.
        log: where faults of the database go, by kind and state alone; standard error when None.
    """

    def __init__(self, url: str, log: Log | None = None) -> None:
        self.log = log or make_log("warning")
        self._url = url
        self._lock = threading.Lock()
        self._engine: sa.Engine | None = None
        self._opened: tuple[DBOSClient, Leases] | None = None

    def new_id(self, kind: str, key: str | None = None) -> str:
        """Random, or the same for the same idempotency key."""
        return str(uuid.uuid4() if key is None else uuid.uuid5(_NAMESPACE, f"{kind}\n{key}"))

    @_answered
    def enqueue(self, kind: str, argument: Record, identifier: str) -> JobStatus:
        """Have a job done; one that is there under the identifier is left as it is."""
        asked: EnqueueOptions = {
            "workflow_name": JOB,
            "queue_name": queue_of(kind),
            "workflow_id": identifier,
            "app_version": RECORDS_VERSION,
        }
        with _needing_room():
            self._client.enqueue(asked, kind, dict(argument))
        return self.status(identifier)

    @_answered
    def status(self, identifier: str) -> JobStatus:
        """What is known of a job; `UnknownJob` when there is none."""
        known = is_identifier(identifier)
        found = self._client.list_workflows(workflow_ids=[identifier], name=JOB) if known else []
        if not found:
            raise UnknownJob("There is no job of this identifier; it may have expired.")
        progress = self._client.get_event(identifier, PROGRESS, 0) or {}
        return job_status(found[0], progress)

    @_answered
    def cancel(self, identifier: str) -> JobStatus:
        """Stop a job with all of its parts."""
        self.status(identifier)
        self._client.cancel_workflow(identifier, cancel_children=True)
        return self.status(identifier)

    @_answered
    def is_wanted(self, identifier: str) -> bool:
        """Whether a job is waiting or running."""
        found = self._client.list_workflows(workflow_ids=[identifier], load_input=False, load_output=False)
        return bool(found) and found[0].status in ("ENQUEUED", "PENDING", "DELAYED")

    @_answered
    def known(self, identifiers: Collection[str]) -> set[str]:
        """Those of the identifiers that a job has."""
        wanted, found = list(identifiers), set[str]()
        for start in range(0, len(wanted), _ASKED_FOR):
            some = wanted[start : start + _ASKED_FOR]
            rows = self._client.list_workflows(workflow_ids=some, name=JOB, load_input=False, load_output=False)
            found |= {row.workflow_id for row in rows}
        return found

    @_answered
    def forget(self, identifier: str) -> None:
        """Remove the record of a job and its parts."""
        self._client.delete_workflow(identifier, delete_children=True)

    @_answered
    def ended_before(self, moment: datetime) -> Iterator[str]:
        """Identifiers of the jobs that ended before a moment."""
        found = self._client.list_workflows(
            name=JOB, completed_before=moment.isoformat(), load_input=False, load_output=False
        )
        return (workflow.workflow_id for workflow in found)

    @_answered
    def backlog(self) -> int:
        """Parts that wait for a worker."""
        return self._open()[1].count(PARTS_QUEUE, "ENQUEUED")

    @_answered
    def unfinished(self) -> int:
        """Jobs that wait or run, less those that wait for archives."""
        return self._open()[1].count(JOBS_QUEUE, "ENQUEUED", "PENDING")

    @_answered
    def workers(self, lease_s: float) -> int:
        """How many workers are alive."""
        return self._open()[1].alive(lease_s)

    def close(self) -> None:
        """Let go of the database."""
        if not self._lock.acquire(timeout=CONNECT_S):  # another thread connects, and is not answered
            return
        try:
            if self._opened is not None:
                client, leases = self._opened
                client.destroy()
                leases.close()
            if self._engine is not None:
                self._engine.dispose()
            self._opened = self._engine = None
        finally:
            self._lock.release()

    @property
    def _client(self) -> DBOSClient:
        return self._open()[0]

    def _open(self) -> tuple[DBOSClient, Leases]:
        if self._opened is not None:
            return self._opened
        if not self._lock.acquire(timeout=CONNECT_S):  # another thread connects, and is not answered
            raise _away()
        try:
            if self._opened is None:
                self._opened = self._connected()
            return self._opened
        finally:
            self._lock.release()

    def _connected(self) -> tuple[DBOSClient, Leases]:
        serializer = json_serializer()
        prepare(self._url)
        if is_postgres(self._url) and self._engine is None:
            self._engine = open_engine(self._url, CONNECTIONS)
        client = DBOSClient(
            system_database_url=self._url,
            system_database_engine=self._engine,
            dbos_system_schema=SCHEMA,
            serializer=serializer,
            application_name=APPLICATION,
            retry_connection_errors=False,
            system_database_pool_size=CONNECTIONS,
        )
        return client, Leases(self._url)


def job_status(workflow: WorkflowStatus, progress: Mapping[str, Any]) -> JobStatus:
    """A workflow's record as the status of a job."""
    state = _STATES.get(workflow.status, JobState.FAILED)
    if state is JobState.QUEUED and progress:
        state = JobState.RUNNING  # waits for another worker to go on
    answer = workflow.output if isinstance(workflow.output, dict) else {}
    problem, problem_kind = _problem(state, answer)
    kind, argument = workflow.input["args"] if workflow.input else ("", {})
    return JobStatus(
        id=workflow.workflow_id,
        kind=kind,
        state=JobState.FAILED if problem else state,
        argument=argument,
        created=_moment(workflow.created_at) or datetime.now(UTC),
        started=_moment(progress.get("started_ms")),
        finished=_moment(workflow.completed_at),
        done=progress.get("done", 0),
        total=progress.get("total", 0),
        problem=problem,
        problem_kind=problem_kind,
        result=answer.get("result"),
    )


def _problem(state: JobState, answer: Mapping[str, Any]) -> tuple[str | None, Kind | None]:
    """Why a job failed, and of which kind that is; records of earlier releases do not say the latter."""
    if state is JobState.FAILED:
        return _FAULT, PROTOCOL_KINDS[500]
    if state is not JobState.DONE:
        return None, None
    return answer.get("problem"), _KINDS.get(answer.get("error", ""))


def _moment(epoch_ms: int | None) -> datetime | None:
    return None if epoch_ms is None else datetime.fromtimestamp(epoch_ms / 1000.0, UTC)
