"""Requests of one key at the same time: one job, with the inputs of the request that made it."""

import io
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

    def put_file(self, key, file):
        with suppress(threading.BrokenBarrierError):
            self._all.wait(20.0)
        super().put_file(key, file)


class FullBlobs(FolderBlobs):
    """A disk without room for large files."""

    def put_file(self, key, file):
        if file.seek(0, io.SEEK_END) > 10:
            raise OSError("The disk is full.")
        super().put_file(key, file)


class AwayBlobs(FolderBlobs):
    """Storage that takes nothing, and removes nothing."""

    def put_file(self, key, file):  # noqa: ARG002
        raise OSError("The object storage does not answer.")

    def delete(self, prefix, check=None):  # noqa: ARG002
        raise OSError("The object storage does not answer.")


class Upload(io.BytesIO):
    """A file of which no more than a piece may be in memory."""

    def read(self, size=-1):
        assert 0 < size <= 1 << 20
        return super().read(size)


def sent(*contents):
    return tuple(map(io.BytesIO, contents))


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
            return content, desk.submit(RECONSTRUCTION_JOB, {"masks": 1}, sent(content), "one", model="m@1")
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
    mine = JobDesk(jobs, blobs, 64).submit(RECONSTRUCTION_JOB, {"masks": 2}, sent(b"1", b"2"), "one", model="m@1")
    jobs.forget(mine.id)  # as if the other request had looked before this one was enqueued
    with pytest.raises(StoreFull):
        JobDesk(jobs, blobs, 64).submit(RECONSTRUCTION_JOB, {"masks": 2}, sent(b"1", b"2" * 100), "one", model="m@1")
    assert JobFiles(blobs, mine.id).input(1, mine.argument[SUBMISSION]) == b"2"
    assert len(list(blobs.list("jobs/"))) == 2


def test_a_storage_that_is_away_is_told_as_one_for_later(jobs, tmp_path):
    with pytest.raises(StoreFull, match="later"):
        JobDesk(jobs, AwayBlobs(tmp_path), 64).submit(RECONSTRUCTION_JOB, {"masks": 1}, sent(b"1"), model="m@1")
    assert jobs.unfinished() == 0


def test_what_is_sent_is_kept_piece_by_piece(jobs, tmp_path):
    content = bytes(range(256)) * 20_000
    made = JobDesk(jobs, FolderBlobs(tmp_path), 64).submit(
        RECONSTRUCTION_JOB, {"masks": 1}, (Upload(content),), model="m@1"
    )
    assert JobFiles(FolderBlobs(tmp_path), made.id).input(0) == content


@pytest.mark.parametrize("named", [None, "m"], ids=["no model named", "one without version"])
def test_a_request_sent_again_after_a_new_version_of_its_model_leads_to_its_job(jobs, tmp_path, named):
    desk, asked = JobDesk(jobs, FolderBlobs(tmp_path), 64), {"model": named, "masks": 1}
    first = desk.submit(RECONSTRUCTION_JOB, asked, sent(b"1"), "one", model="m@1")
    again = desk.submit(RECONSTRUCTION_JOB, asked, sent(b"1"), "one", model="m@2")
    assert (again.id, again.argument["model"]) == (first.id, "m@1")
    with pytest.raises(InvalidParameter):
        desk.submit(RECONSTRUCTION_JOB, {**asked, "model": "m@2"}, sent(b"1"), "one", model="m@2")


class FullJobs(DbosJobs):
    """A database without room for one more job."""

    def enqueue(self, *_):
        raise StoreFull("The jobs' database has no room for the job.")


@pytest.mark.parametrize("key", [None, "one"])
def test_a_job_that_cannot_be_kept_leaves_nothing_of_what_was_sent(sqlite_url, tmp_path, key):
    jobs, blobs = FullJobs(sqlite_url), FolderBlobs(tmp_path / "files")
    with pytest.raises(StoreFull):
        JobDesk(jobs, blobs, 64).submit(RECONSTRUCTION_JOB, {"masks": 1}, sent(b"1"), key, model="m@1")
    assert list(blobs.list("jobs/")) == []
    jobs.close()


def test_the_earlier_job_of_a_key_is_found_for_the_same_request_alone(jobs, tmp_path):
    desk = JobDesk(jobs, FolderBlobs(tmp_path), 64)
    assert desk.earlier(RECONSTRUCTION_JOB, {"masks": 1}, sent(b"1"), "one") is None
    made = desk.submit(RECONSTRUCTION_JOB, {"masks": 1}, sent(b"1"), "one", model="m@1")
    assert desk.earlier(RECONSTRUCTION_JOB, {"masks": 1}, sent(b"1"), "one") == made
    assert desk.earlier(RECONSTRUCTION_JOB, {"masks": 1}, sent(b"1"), None) is None
    with pytest.raises(InvalidParameter):
        desk.earlier(RECONSTRUCTION_JOB, {"masks": 1}, sent(b"2"), "one")
