"""The program of one worker process, and the processes that ``serve`` keeps beside itself.

Workers run with low priority and one thread a network, so that requests which somebody waits for come first.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from datetime import UTC, datetime, timedelta

from model.interruption import Check, unchecked
from service.adapters.images import write_nifti
from service.adapters.jobs.worker import WorkerOptions, running_worker
from service.adapters.mesh_formats import write_mesh
from service.errors import Cancelled
from service.job_files import JobFiles
from service.job_ports import BlobStore, JobEngine, JobKind
from service.jobs.kinds import all_kinds
from service.jobs.priority import stand_back
from service.jobs.strays import Strays
from service.jobs.tools import JobTools
from service.model_registry import ModelRegistry
from service.observability import Log, going_on
from service.settings import Settings
from service.stores import jobs_url, open_blobs, open_jobs, open_results, replica_name
from service.wiring import mask_reader

#: A worker that died is started again after so long (s).
_RESTART_AFTER_S = 1.0
#: A worker that was told to stop has ended after so long (s), one way or the other.
_LEAVE_WITHIN_S = 30.0


def worker_options(settings: Settings, slot: int) -> WorkerOptions:
    """How the worker of a slot works; its name is the same after each restart."""
    return WorkerOptions(jobs_url(settings), f"{replica_name(settings)}-{slot}", settings.job_lease_s)


def make_tools(settings: Settings, registry: ModelRegistry, log: Log) -> JobTools:
    """The wired parts of a worker."""
    blobs = open_blobs(settings)
    return JobTools(
        registry=registry,
        store=open_results(settings, blobs),
        blobs=blobs,
        read_mask=mask_reader(settings),
        write_mesh=write_mesh,
        write_volume=write_nifti,
        log=log,
        max_voxels=settings.max_voxels,
        archive_limits=settings.archive_limits,
    )


def run_worker(settings: Settings, registry: ModelRegistry, slot: int, log: Log, *, attached: bool = False) -> None:
    """Work until SIGTERM or SIGINT; attached, also until standard input ends because who held it is gone."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    threading.Thread(target=_leave_within, args=(_LEAVE_WITHIN_S, stop), daemon=True).start()
    if attached:
        threading.Thread(target=_stop_with_input, args=(stop,), daemon=True).start()
    stand_back(settings.job_nice)
    tools = make_tools(settings, registry, log)
    kinds, options = (*all_kinds(tools), *_pacs_kinds(settings, tools)), worker_options(settings, slot)
    with closing(open_jobs(settings, log)) as jobs, running_worker(kinds, options, log):
        strays = Strays(jobs, tools.blobs)
        log.info("worker started", slot=slot)
        while not stop.wait(settings.sweep_interval_s):
            remove_expired(jobs, tools.blobs, strays, settings.result_lifetime_s, log, _until(stop))
            with going_on(log, "models cannot be found anew"):
                registry.refresh()
    log.info("worker stopped", slot=slot)
    sys.stderr.flush()
    os._exit(0)  # threads that follow jobs may wait for a database for ever


def _pacs_kinds(settings: Settings, tools: JobTools) -> tuple[JobKind, ...]:
    """Drawings from picture archives, where a file is set."""
    if settings.pacs_file is None:
        return ()
    from service.jobs.pacs import pacs_kinds  # the extra pacs is needed only here

    return pacs_kinds(settings, settings.pacs_file, tools.registry, tools.blobs, tools.log)


def _leave_within(limit_s: float, stop: threading.Event) -> None:
    """Once told to stop, end this process even if its database or storage is away and nothing can be handed back."""
    stop.wait()
    time.sleep(limit_s)
    os._exit(1)


def _until(stop: threading.Event) -> Check:
    """What ends a sweep once the worker is told to stop; a later one goes on with the rest."""

    def check() -> None:
        if stop.is_set():
            raise Cancelled("The worker was told to stop.")

    return check


def _stop_with_input(stop: threading.Event) -> None:
    sys.stdin.buffer.read()
    stop.set()


def remove_expired(
    jobs: JobEngine, blobs: BlobStore, strays: Strays, lifetime_s: float, log: Log, check: Check = unchecked
) -> None:
    """Forget jobs that ended so long ago, with their files, and files that belong to no job.

    Args:
        jobs: those that may have ended.
        blobs: where their files are.
        strays: finds files that belong to no job.
        lifetime_s: how long a job is kept after its end.
        log: where it is told that something cannot be removed.
        check: passed before each piece of files; when it raises `Cancelled`, the rest is left for a later time.
    """
    with going_on(log, "expired jobs cannot be removed"), suppress(Cancelled):
        for identifier in jobs.ended_before(datetime.now(UTC) - timedelta(seconds=lifetime_s)):
            JobFiles(blobs, identifier).remove(check)
            jobs.forget(identifier)
    with going_on(log, "files without a job cannot be removed"), suppress(Cancelled):
        strays.sweep(check)


def start_worker(slot: int) -> subprocess.Popen[bytes]:
    """The program ``worker`` of a slot; it ends with this process."""
    command = [sys.executable, "-m", "service.cli", "worker", "--slot", str(slot), "--attached"]
    return subprocess.Popen(command, stdin=subprocess.PIPE)


@contextmanager
def supervised_workers(
    count: int, log: Log, start: Callable[[int], "subprocess.Popen[bytes]"] = start_worker
) -> Iterator[Callable[[], None]]:
    """So many worker processes while the context lasts; one that dies is started again under the same name.

    Args:
        count: how many.
        log: where it is told that one died or could not be started.
        start: starts the one of a slot.

    Yields:
        What tells them to end, for who has more to do before the context ends.
    """
    stop = threading.Event()
    tasks = [(slot, stop, log, start) for slot in range(count)]
    keepers = [threading.Thread(target=_keep, args=task, name=f"worker-{task[0]}") for task in tasks]
    for keeper in keepers:
        keeper.start()
    try:
        yield stop.set
    finally:
        stop.set()
        for keeper in keepers:
            keeper.join()


def _keep(slot: int, stop: threading.Event, log: Log, start: Callable[[int], "subprocess.Popen[bytes]"]) -> None:
    while not stop.is_set():
        with going_on(log, "worker cannot be started"):
            with start(slot) as worker:
                while worker.poll() is None and not stop.wait(0.2):
                    continue
                worker.terminate()
            if not stop.is_set():
                log.warning("worker ended and is started again", slot=slot, status=worker.returncode)
        stop.wait(_RESTART_AFTER_S)
