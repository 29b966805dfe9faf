"""Requests of one key at the same time: one job, with the inputs of the request that made it."""

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from model.errors import InvalidParameter
from service.adapters.blobs import FolderBlobs
from service.adapters.jobs.client import DbosJobs
from service.errors import StoreFull
from service.job_files import JobFiles
from service.job_submission import SUBMISSION, JobDesk
from service.ports import RECONSTRUCTION_JOB

TOGETHER = 12


class MeetingBlobs(FolderBlobs):
    """Goes on once as many writers are there, so that none of them has seen the other's job."""

    def __init__(self, folder, writers):
        super().__init__(folder)
        self._all = threading.Barrier(writers)

    def put(self, key, data):
        with suppress(threading.BrokenBarrierError):
            self._all.wait(20.0)
        super().put(key, data)


class FullBlobs(FolderBlobs):
    """A disk without room for large files."""

    def put(self, key, data):
        if len(data) > 10:
            raise OSError("The disk is full.")
        super().put(key, data)


@pytest.fixture
def jobs(url):
    engine = DbosJobs(url)
    engine.unfinished()  # connects
    yield engine
    engine.close()


def test_requests_of_one_key_at_the_same_time_make_one_job_of_one_of_them(jobs, tmp_path):
    blobs = MeetingBlobs(tmp_path, TOGETHER)
    desk = JobDesk(jobs, blobs, 64)

    def submit(number):
        content = b"ab"[number % 2 : number % 2 + 1]
        try:
            return content, desk.submit(RECONSTRUCTION_JOB, {"masks": 1}, (content,), "one")
        except InvalidParameter:
            return content, None

    with ThreadPoolExecutor(TOGETHER) as pool:
        answers = list(pool.map(submit, range(TOGETHER)))
    taken = {content for content, status in answers if status is not None}
    assert len(taken) == 1
    assert sum(status is None for _, status in answers) == TOGETHER // 2
    (job,) = {status.id for _, status in answers if status is not None}
    kept = JobFiles(blobs, job).input(0, jobs.status(job).argument[SUBMISSION])
    assert {kept} == taken
    assert len(list(blobs.list(f"jobs/{job}/"))) == 1


def test_inputs_that_cannot_be_kept_take_none_of_another_submission(jobs, tmp_path):
    blobs = FullBlobs(tmp_path)
    mine = JobDesk(jobs, blobs, 64).submit(RECONSTRUCTION_JOB, {"masks": 2}, (b"1", b"2"), "one")
    jobs.forget(mine.id)  # as if the other request had looked before this one was enqueued
    with pytest.raises(StoreFull):
        JobDesk(jobs, blobs, 64).submit(RECONSTRUCTION_JOB, {"masks": 2}, (b"1", b"2" * 100), "one")
    assert JobFiles(blobs, mine.id).input(1, mine.argument[SUBMISSION]) == b"2"
    assert len(list(blobs.list("jobs/"))) == 2
