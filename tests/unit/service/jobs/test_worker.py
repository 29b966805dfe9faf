"""What a worker does besides its jobs goes on, whatever becomes of one turn."""

import json
from io import StringIO

from service.adapters.blobs import FolderBlobs
from service.jobs.strays import LOOK_EVERY_S, Strays
from service.jobs.worker import remove_expired
from service.observability import make_log


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
