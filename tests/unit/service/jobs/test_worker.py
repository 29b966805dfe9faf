"""What a worker does besides its jobs goes on, whatever becomes of one turn."""

import json
import subprocess
import sys
from io import StringIO

from service.adapters.blobs import FolderBlobs
from service.jobs.strays import LOOK_EVERY_S, Strays
from service.jobs.worker import remove_expired, supervised_workers
from service.observability import make_log
from tests.waiting import until


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
