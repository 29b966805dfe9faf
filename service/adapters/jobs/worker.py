"""One worker of jobs: does parts of the kinds it has, one at a time, and follows jobs from checkpoint to checkpoint.

DBOS holds one application in a process, so a process is one worker. Its name (executor) is stable: what it held when it
was killed it takes up again when it comes back; when it does not, another worker does.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from dbos import DBOS, DBOSConfig, PortableWorkflowError, SetEnqueueOptions, SetWorkflowID, StepOptions
from dbos import error as dbos_error

from model.errors import MorphoFlowError
from service.adapters.jobs.busy import Busy
from service.adapters.jobs.client import FAULTS, PROGRESS, DbosJobs
from service.adapters.jobs.database import (
    APPLICATION,
    DRAWING_PARTS_QUEUE,
    JOB,
    JOBS_QUEUE,
    PART,
    PARTS_QUEUE,
    PATIENT_QUEUE,
    RECORDS_VERSION,
    SCHEMA,
    Leases,
    bounded,
    json_serializer,
    parts_queue_of,
    prepare,
    queue_of,
)
from service.errors import KINDS, Cancelled, GivenUp, Overloaded, StoreFull
from service.job_ports import Check, JobKind, Record
from service.observability import Log, make_log

#: Jobs that one worker follows at the same time; following one is waiting for its parts, or for an archive.
JOBS_FOLLOWED, PATIENT_FOLLOWED = 16, 128
#: Parts of one job that are queued or done at any time, so that no job fills the database.
WINDOW = 64
#: Connections of one worker to PostgreSQL, at most.
CONNECTIONS = 6
#: How often (s) queues of jobs and of parts are read, answers of parts are asked for, and a running part asks whether
#: its job is wanted. Reading an empty queue takes some ms of a core.
JOBS_POLL_S, PARTS_POLL_S, ANSWER_POLL_S, CHECK_S = 0.2, 0.1, 0.2, 0.3
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
        # No bound on statements here: a worker waits for a slow database, nobody waits for it.
        "system_database_url": bounded(options.url),
        "dbos_system_schema": SCHEMA,
        "application_version": RECORDS_VERSION,
        "executor_id": options.executor,
        "serializer": serializer,
        "log_level": "CRITICAL",
        "run_migrations": False,
        "sys_db_pool_size": CONNECTIONS,
    }
    dbos, busy = DBOS(config=config), Busy()
    _register({kind.name: kind for kind in kinds}, jobs, busy, log or make_log("error"))
    DBOS.listen_queues(sorted({queue for kind in kinds for queue in (queue_of(kind.name), parts_queue_of(kind.name))}))
    leases, stop = Leases(options.url), threading.Event()
    leases.renew(options.executor)
    DBOS.launch()
    DBOS.register_queue(JOBS_QUEUE, worker_concurrency=JOBS_FOLLOWED, polling_interval_sec=JOBS_POLL_S)
    DBOS.register_queue(PATIENT_QUEUE, worker_concurrency=PATIENT_FOLLOWED, polling_interval_sec=JOBS_POLL_S)
    for queue in (PARTS_QUEUE, DRAWING_PARTS_QUEUE):
        DBOS.register_queue(queue, worker_concurrency=1, polling_interval_sec=PARTS_POLL_S)
    # By themselves, for what is taken over may have to wait for the database far longer than a lease lasts.
    keepers = [
        threading.Thread(target=_every, args=(turn, options.lease_s / 4, stop), name=turn.func.__name__, daemon=True)
        for turn in (partial(leases.renew, options.executor), partial(_take_over, leases, options))
    ]
    for keeper in keepers:
        keeper.start()
    try:
        yield
    finally:
        for event in dbos.background_thread_stop_events:  # no more parts are taken
            event.set()
        busy.end(options.drain_s)
        DBOS._recover_pending_workflows([options.executor])
        DBOS.destroy(destroy_registry=True)
        stop.set()
        for keeper in keepers:
            keeper.join(options.lease_s)
        leases.lapse(options.executor)  # a part that was taken from the queue in the meantime is the next worker's
        leases.close()
        jobs.close()


def _register(kinds: Mapping[str, JobKind], jobs: DbosJobs, busy: Busy, log: Log) -> None:
    @DBOS.workflow(name=PART, max_recovery_attempts=MAX_DEATHS)
    def part(job: str, kind: str, name: str, item: dict[str, Any]) -> dict[str, Any]:
        check = _rarely(lambda: _require_wanted(jobs, job))
        check()
        with busy.alone(), _told(log, job, name):
            try:
                return dict(DBOS.run_step(_tried_again(name), kinds[kind].parts[name], item, check))
            finally:
                _forget_deleted(jobs, job, kinds[kind])

    @DBOS.workflow(name=JOB, max_recovery_attempts=None)
    def job(kind: str, argument: dict[str, Any]) -> dict[str, Any]:
        identifier = DBOS.workflow_id
        assert identifier is not None
        run = _Run(identifier, kind, part, jobs, busy)
        try:
            return {"result": dict(kinds[kind].follow(run, argument))}
        except MorphoFlowError as error:
            return {"problem": str(error), "error": type(error).__name__}
        except PortableWorkflowError as error:
            if error.name not in _PROJECT_ERRORS:
                raise
            return {"problem": error.message, "error": error.name}


def _tried_again(name: str) -> StepOptions:
    """A step that is tried again when its disk or storage fails."""
    return {
        "name": name,
        "retries_allowed": True,
        "max_attempts": ATTEMPTS,
        "should_retry": lambda error: isinstance(error, OSError | StoreFull),
    }


@contextmanager
def _told(log: Log, job: str, part: str) -> Iterator[None]:
    """Log a part's time, and what is no error of this project's own."""
    began = time.perf_counter()
    log.debug("part begun", job=job, part=part)
    try:
        yield
    except MorphoFlowError:
        raise
    except Exception as fault:
        log.error("fault in a job", job=job, exc_info=fault)
        raise
    finally:
        log.debug("part ended", job=job, part=part, seconds=round(time.perf_counter() - began, 3))


class _Run:
    """The `JobRun` of a workflow."""

    def __init__(
        self, identifier: str, kind: str, part: Callable[..., dict[str, Any]], jobs: DbosJobs, busy: Busy
    ) -> None:
        self._id = identifier
        self._kind = kind
        self._part = part
        self._jobs = jobs
        self._busy = busy
        self._started_ms = self.step("start", lambda: {"ms": int(time.time() * 1000)})["ms"]
        self._done = self._total = 0

    @property
    def id(self) -> str:
        """The job's identifier."""
        return self._id

    def step(self, name: str, work: Callable[[], Record]) -> Record:
        """Short work that is done once."""
        with self._busy.one():
            return DBOS.run_step(_tried_again(name), lambda: dict(work()))

    def wait(self, seconds: float) -> None:
        """Let time pass; after a restart, what is left of it."""
        end = self.step("wait", lambda: {"end": time.time() + seconds})["end"]
        self._busy.pause(max(0.0, end - time.time()))

    def expect(self, total: int) -> None:
        """How many items the job has."""
        self._total = total
        with self._busy.one():
            self._report()

    def spread(self, part: str, items: Sequence[Record], sizes: Sequence[int] | None = None) -> list[Record]:
        """A part for each item, a window of them at a time; the nearest item first among all jobs."""
        counts = [1] * len(items) if sizes is None else sizes
        with self._busy.one():
            waiting = deque(self._begin(part, number, items[number]) for number in range(min(WINDOW, len(items))))
        answers: list[Record] = []
        while waiting:
            first = waiting.popleft()
            self._await_end(first.workflow_id)
            self._require_known()
            with self._busy.one():
                answers.append(_answer(first))
                self._done += counts[len(answers) - 1]
                self._report()
                following = len(answers) + len(waiting)
                if following < len(items):
                    waiting.append(self._begin(part, following, items[following]))
        return answers

    def _begin(self, name: str, number: int, item: Record) -> Any:
        with SetWorkflowID(f"{self._id}/{name}/{number}"), SetEnqueueOptions(priority=number + 1):
            queue = parts_queue_of(self._kind)
            return DBOS.enqueue_workflow(queue, self._part, self._id, self._kind, name, dict(item))

    def _await_end(self, part: str) -> None:
        """Until a part has ended, wherever it is done."""
        while self._is_wanted(part):
            self._busy.pause(ANSWER_POLL_S)

    def _is_wanted(self, part: str) -> bool:
        try:
            return self._jobs.is_wanted(part)
        except Overloaded:  # the database is away; the next look may find it
            return True

    def _require_known(self) -> None:
        """A job that was deleted has no answers any more; one would be waited for without end."""
        with suppress(Overloaded):  # a database that is away does not say that it was deleted
            if not self._jobs.known([self._id]):
                raise Cancelled("The job was deleted.")

    def _report(self) -> None:
        DBOS.set_event(PROGRESS, {"done": self._done, "total": self._total, "started_ms": self._started_ms})


def _answer(part: Any) -> dict[str, Any]:
    """What a part that has ended answers."""
    try:
        answer: dict[str, Any] = part.get_result(polling_interval_sec=ANSWER_POLL_S)
    except dbos_error.DBOSAwaitedWorkflowMaxRecoveryAttemptsExceeded:
        raise GivenUp("A part of the job ended its worker again and again; it was given up.") from None
    return answer


def _require_wanted(jobs: DbosJobs, job: str) -> None:
    with suppress(Overloaded):  # a database that is away does not say that nobody wants the job
        if not jobs.is_wanted(job):
            raise Cancelled("The job was cancelled.")


def _forget_deleted(jobs: DbosJobs, job: str, kind: JobKind) -> None:
    """Remove what a part may have written after its job had been deleted with all files."""
    with suppress(Overloaded, OSError):  # what stays is found to be astray later
        if not jobs.known([job]):
            kind.forget(job)


def _rarely(check: Check) -> Check:
    """The check, but not more often than it may cost."""
    last = [float("-inf")]

    def checked() -> None:
        now = time.monotonic()
        if now - last[0] >= CHECK_S:
            check()
            last[0] = now

    return checked


def _every(turn: Callable[[], None], pause_s: float, stop: threading.Event) -> None:
    """Take a turn now and then; one that the database fails is not the last."""
    ended = False
    while not ended:
        with suppress(*FAULTS):
            turn()
        ended = stop.wait(pause_s)


def _take_over(leases: Leases, options: WorkerOptions) -> None:
    """Take over what executors hold whose lease has run out."""
    lost = [executor for executor in leases.lost(options.lease_s) if executor != options.executor]
    if lost:
        DBOS._recover_pending_workflows(lost)
    for executor in lost:
        leases.end(executor)
