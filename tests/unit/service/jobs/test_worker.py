"""What a worker does besides its jobs goes on, whatever becomes of one turn."""

import json
import signal
import subprocess
import sys
from io import StringIO

from service.adapters.blobs import FolderBlobs
from service.errors import Cancelled
from service.jobs.strays import LOOK_EVERY_S, Strays
from service.jobs.worker import remove_expired, supervised_workers
from service.observability import make_log
from tests.waiting import until

#: A worker over an expired job whose files have no end.
_REMOVES_FOR_EVER = """
import sys, time
from pathlib import Path
import service.jobs.worker as worker
from service.adapters.blobs import FolderBlobs
from service.adapters.jobs.client import DbosJobs
from service.model_registry import ModelRegistry
from service.observability import make_log
from service.settings import Settings
from service.stores import jobs_url

class Endless(FolderBlobs):
    def delete(self, prefix, check=lambda: None):
        print("removing", flush=True)
        while True:
            check()
            time.sleep(0.05)

folder = Path(sys.argv[1])
settings = Settings(results_folder=folder / "results", sweep_interval_s=0.2, result_lifetime_s=0.1)
jobs = DbosJobs(jobs_url(settings))
identifier = jobs.new_id("samples")
jobs.enqueue("samples", {}, identifier)
jobs.cancel(identifier)
jobs.close()
worker.open_blobs = lambda _: Endless(folder / "files")
worker.run_worker(settings, ModelRegistry({}), 0, make_log("info"))
"""


class Forgetful:
    """An engine of jobs that knows none, and cannot say which have ended."""

    def ended_before(self, moment):
        raise TypeError(moment)

    def known(self, identifiers):  # noqa: ARG002
        return set()


def test_files_of_no_job_are_removed_even_where_expired_jobs_cannot_be_found(tmp_path):
    blobs, log, jobs, now = FolderBlobs(tmp_path), StringIO(), Forgetful(), 0.0
    blobs.put("jobs/11111111-1111-4111-8111-111111111111/inputs/00000000", b"1")
    strays = Strays(jobs, blobs, lambda: now)
    for turn in (1, 2):
        now = turn * LOOK_EVERY_S
        remove_expired(jobs, blobs, strays, 10.0, make_log("info", log))
    told = [json.loads(line)["event"] for line in log.getvalue().splitlines()]
    assert told == ["expired jobs cannot be removed"] * 2
    assert not list(blobs.folders("jobs/"))


class Ended:
    """An engine of jobs that have all ended, and whose records stay."""

    def __init__(self, *identifiers):
        self.left = list(identifiers)

    def ended_before(self, moment):  # noqa: ARG002
        return iter(list(self.left))

    def known(self, identifiers):
        return set(identifiers)

    def forget(self, identifier):
        self.left.remove(identifier)


def test_expired_jobs_are_removed_until_the_worker_is_told_to_stop_and_the_rest_at_a_later_turn(tmp_path):
    blobs, log, jobs, turns = FolderBlobs(tmp_path), StringIO(), Ended("a", "b", "c"), []
    for job in jobs.left:
        blobs.put(f"jobs/{job}/inputs/00000000", b"1")

    def check():
        turns.append(1)
        if len(turns) > 1:
            raise Cancelled("enough")

    remove_expired(jobs, blobs, Strays(jobs, blobs), 10.0, make_log("info", log), check)
    assert jobs.left == ["b", "c"]
    assert set(blobs.folders("jobs/")) == {"b", "c"}
    assert not log.getvalue()
    remove_expired(jobs, blobs, Strays(jobs, blobs), 10.0, make_log("info", log))
    assert jobs.left == []


def test_a_worker_that_is_told_to_stop_leaves_in_the_midst_of_a_removal(tmp_path):
    program = [sys.executable, "-c", _REMOVES_FOR_EVER, str(tmp_path)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True, stderr=subprocess.DEVNULL) as worker:
        assert worker.stdout.readline() == "removing\n"
        worker.send_signal(signal.SIGTERM)
        try:
            assert worker.wait(60.0) == 0
        finally:
            worker.kill()


def test_a_worker_that_dies_or_cannot_be_started_is_followed_by_another():
    log, started = StringIO(), []

    def start(slot):
        started.append(slot)
        if len(started) == 1:
            raise OSError("no room for another process")
        last = len(started) > 2
        return subprocess.Popen([sys.executable, "-c", "input()" if last else "exit(3)"], stdin=subprocess.PIPE)

    with supervised_workers(1, make_log("info", log), start) as end:
        until(lambda: len(started) == 3)
        end()
    entries = [json.loads(line) for line in log.getvalue().splitlines()]
    assert [entry["event"] for entry in entries] == ["worker cannot be started", "worker ended and is started again"]
    assert entries[1]["status"] == 3
    assert started == [0, 0, 0]
