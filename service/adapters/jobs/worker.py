"""One worker of jobs: takes parts from the queue, one at a time, and follows jobs from checkpoint to checkpoint.

DBOS holds one application in a process, so a process is one worker. Its name (executor) is stable: what it held when it
was killed it takes up again when it comes back; when it does not, another worker does.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from dbos import DBOS, DBOSConfig, PortableWorkflowError, SetEnqueueOptions, SetWorkflowID, StepOptions
from sqlalchemy.exc import DBAPIError

from model.errors import MorphoFlowError
from service.adapters.jobs.client import PROGRESS, DbosJobs
from service.adapters.jobs.database import (
    APPLICATION,
    JOB,
    JOBS_QUEUE,
    PART,
    PARTS_QUEUE,
    RECORDS_VERSION,
    SCHEMA,
    Leases,
    json_serializer,
    prepare,
)
from service.errors import KINDS, Cancelled, Overloaded, StoreFull
from service.job_ports import Check, JobKind, Record
from service.observability import Log, make_log

#: Jobs that one worker follows at the same time; following one is waiting for its parts.
JOBS_FOLLOWED = 16
#: Parts of one job that are queued or done at any time, so that no job fills the database.
WINDOW = 64
#: Connections of one worker to PostgreSQL, at most.
CONNECTIONS = 6
#: How often (s) queues are read, answers of parts are asked for, and a running part asks whether its job is wanted.
POLL_S, ANSWER_POLL_S, CHECK_S = 0.1, 0.2, 0.3
#: After so many workers have died over one part it is given up.
MAX_DEATHS = 20
#: A part whose disk or storage fails is tried again after 1, 2, 4, ... s.
ATTEMPTS = 8

_PROJECT_ERRORS = frozenset(kind.__name__ for kind in KINDS)


@dataclass(frozen=True)
class WorkerOptions:
    """How a worker works.

    Attributes:
        url: of the jobs' database.
        executor: its stable name, of no other worker.
        lease_s: a worker not seen for so long is taken for gone.
        drain_s: how long it may finish at the end what it has begun.
    """

    url: str
    executor: str
    lease_s: float = 10.0
    drain_s: float = 20.0


@contextmanager
def running_worker(kinds: Sequence[JobKind], options: WorkerOptions, log: Log | None = None) -> Iterator[None]:
    """A worker that takes jobs of these kinds while the context lasts; parts begun are finished or handed back."""
    serializer = json_serializer()
    prepare(options.url)
    jobs = DbosJobs(options.url)
    config: DBOSConfig = {
        "name": APPLICATION,
        "system_database_url": options.url,
        "dbos_system_schema": SCHEMA,
        "application_version": RECORDS_VERSION,
        "executor_id": options.executor,
        "serializer": serializer,
        "log_level": "CRITICAL",
        "run_migrations": False,
        "sys_db_pool_size": CONNECTIONS,
    }
    dbos, busy = DBOS(config=config), _Busy()
    _register({kind.name: kind for kind in kinds}, jobs, busy, log or make_log("error"))
    DBOS.listen_queues([JOBS_QUEUE, PARTS_QUEUE])
    leases, stop = Leases(options.url), threading.Event()
    leases.renew(options.executor)
    DBOS.launch()
    DBOS.register_queue(JOBS_QUEUE, worker_concurrency=JOBS_FOLLOWED, polling_interval_sec=POLL_S)
    DBOS.register_queue(PARTS_QUEUE, worker_concurrency=1, polling_interval_sec=POLL_S)
    keeper = threading.Thread(target=_keep_lease, args=(leases, options, stop), name="lease", daemon=True)
    keeper.start()
    try:
        yield
    finally:
        for event in dbos.background_thread_stop_events:  # no more parts are taken
            event.set()
        busy.wait(options.drain_s)
        DBOS._recover_pending_workflows([options.executor])
        DBOS.destroy(destroy_registry=True)
        stop.set()
        keeper.join()
        leases.end(options.executor)
        leases.close()
        jobs.close()


class _Busy:
    """Counts the parts that run."""

    def __init__(self) -> None:
        self._count = 0
        self._changed = threading.Condition()

    @contextmanager
    def one(self) -> Iterator[None]:
        with self._changed:
            self._count += 1
        try:
            yield
        finally:
            with self._changed:
                self._count -= 1
                self._changed.notify_all()

    def wait(self, limit_s: float) -> None:
        """Until none runs, but no longer than so."""
        with self._changed:
            self._changed.wait_for(lambda: self._count == 0, limit_s)


def _register(kinds: Mapping[str, JobKind], jobs: DbosJobs, busy: _Busy, log: Log) -> None:
    @DBOS.workflow(name=PART, max_recovery_attempts=MAX_DEATHS)
    def part(job: str, kind: str, name: str, item: dict[str, Any]) -> dict[str, Any]:
        check = _rarely(lambda: _require_wanted(jobs, job))
        check()
        options: StepOptions = {
            "name": name,
            "retries_allowed": True,
            "max_attempts": ATTEMPTS,
            "should_retry": lambda error: isinstance(error, OSError | StoreFull),
        }
        with busy.one(), _told(log, job):
            return dict(DBOS.run_step(options, kinds[kind].parts[name], item, check))

    @DBOS.workflow(name=JOB, max_recovery_attempts=None)
    def job(kind: str, argument: dict[str, Any]) -> dict[str, Any]:
        identifier = DBOS.workflow_id
        assert identifier is not None
        run = _Run(identifier, kind, part)
        try:
            return {"result": dict(kinds[kind].follow(run, argument))}
        except MorphoFlowError as error:
            return {"problem": str(error)}
        except PortableWorkflowError as error:
            if error.name not in _PROJECT_ERRORS:
                raise
            return {"problem": error.message}


@contextmanager
def _told(log: Log, job: str) -> Iterator[None]:
    """Log what is no error of this project's own."""
    try:
        yield
    except MorphoFlowError:
        raise
    except Exception as fault:
        log.error("fault in a job", job=job, exc_info=fault)
        raise


class _Run:
    """The `JobRun` of a workflow."""

    def __init__(self, identifier: str, kind: str, part: Callable[..., dict[str, Any]]) -> None:
        self._id = identifier
        self._kind = kind
        self._part = part
        self._started_ms = self.step("start", lambda: {"ms": int(time.time() * 1000)})["ms"]
        self._done = self._total = 0

    @property
    def id(self) -> str:
        """The job's identifier."""
        return self._id

    def step(self, name: str, work: Callable[[], Record]) -> Record:
        """Short work that is done once."""
        return DBOS.run_step({"name": name}, lambda: dict(work()))

    def expect(self, total: int) -> None:
        """How many items the job has."""
        self._total = total
        self._report()

    def spread(self, part: str, items: Sequence[Record], sizes: Sequence[int] | None = None) -> list[Record]:
        """A part for each item, a window of them at a time; the nearest item first among all jobs."""
        counts = [1] * len(items) if sizes is None else sizes
        waiting = deque(self._begin(part, number, items[number]) for number in range(min(WINDOW, len(items))))
        answers: list[Record] = []
        while waiting:
            answers.append(waiting.popleft().get_result(polling_interval_sec=ANSWER_POLL_S))
            self._done += counts[len(answers) - 1]
            self._report()
            following = len(answers) + len(waiting)
            if following < len(items):
                waiting.append(self._begin(part, following, items[following]))
        return answers

    def _begin(self, name: str, number: int, item: Record) -> Any:
        with SetWorkflowID(f"{self._id}/{name}/{number}"), SetEnqueueOptions(priority=number + 1):
            return DBOS.enqueue_workflow(PARTS_QUEUE, self._part, self._id, self._kind, name, dict(item))

    def _report(self) -> None:
        DBOS.set_event(PROGRESS, {"done": self._done, "total": self._total, "started_ms": self._started_ms})


def _require_wanted(jobs: DbosJobs, job: str) -> None:
    with suppress(Overloaded):  # a database that is away does not say that nobody wants the job
        if not jobs.is_wanted(job):
            raise Cancelled("The job was cancelled.")


def _rarely(check: Check) -> Check:
    """The check, but not more often than it may cost."""
    last = [float("-inf")]

    def checked() -> None:
        now = time.monotonic()
        if now - last[0] >= CHECK_S:
            check()
            last[0] = now

    return checked


def _keep_lease(leases: Leases, options: WorkerOptions, stop: threading.Event) -> None:
    """Renew the own lease and take over what executors hold whose lease has run out."""
    while not stop.wait(options.lease_s / 4):
        try:
            leases.renew(options.executor)
            lost = [executor for executor in leases.lost(options.lease_s) if executor != options.executor]
            if lost:
                DBOS._recover_pending_workflows(lost)
            for executor in lost:
                leases.end(executor)
        except DBAPIError:  # the database is away; the next turn tries again
            continue
