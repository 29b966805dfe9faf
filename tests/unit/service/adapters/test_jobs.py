"""The engine of jobs on real databases: SQLite always, PostgreSQL where one listens on this machine."""

import io
import json
import sqlite3
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psycopg
import pytest
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ProgrammingError

from benchmarks.ports import free_port
from model.errors import InvalidMask
from service.adapters.jobs.busy import Busy, Ending
from service.adapters.jobs.client import DbosJobs
from service.adapters.jobs.database import DRAWING_PARTS_QUEUE, PARTS_QUEUE, Leases, bounded, is_made
from service.adapters.jobs.worker import WorkerOptions, running_worker
from service.errors import KINDS, Overloaded, StoreFull, UnknownJob
from service.job_ports import JobKind, JobState, JobStatus
from service.observability import make_log
from service.pacs_ports import DRAWING_JOB
from tests.small_disks import fill, small_disk
from tests.waiting import until


def squares(seen: list[int], fail: tuple[int, ...] = (), fault: Exception | None = None) -> JobKind:
    def follow(run, argument):
        run.expect(argument["count"])
        answers = run.spread("square", [{"x": x} for x in range(argument["count"])])
        return {"sum": sum(answer["y"] for answer in answers)}

    def square(item, check):
        check()
        seen.append(item["x"])
        if item["x"] in fail and seen.count(item["x"]) == 1:
            raise fault or OSError("The disk is full.")
        return {"y": item["x"] ** 2}

    return JobKind("squares", follow, {"square": square})


def awaited(jobs: DbosJobs, identifier: str, wanted=lambda status: status.state.is_final) -> JobStatus:
    limit = time.monotonic() + 60.0
    while not wanted(status := jobs.status(identifier)) and time.monotonic() < limit:
        time.sleep(0.05)
    return status


def test_a_job_is_done_in_parts_and_counted(url):
    jobs, seen = DbosJobs(url), []
    identifier = jobs.new_id("squares")
    assert jobs.enqueue("squares", {"count": 7}, identifier).state is JobState.QUEUED
    with running_worker([squares(seen)], WorkerOptions(url, "a-0")):
        status = awaited(jobs, identifier)
    assert (status.state, status.done, status.total, status.result) == (JobState.DONE, 7, 7, {"sum": 91})
    assert sorted(seen) == list(range(7))
    assert list(jobs.ended_before(datetime.now(UTC) + timedelta(minutes=1))) == [identifier]
    jobs.forget(identifier)
    with pytest.raises(UnknownJob):
        jobs.status(identifier)
    jobs.close()


def test_the_same_key_is_the_same_job(sqlite_url):
    jobs = DbosJobs(sqlite_url)
    first, again = jobs.new_id("squares", "mine"), jobs.new_id("squares", "mine")
    assert first == again != jobs.new_id("squares", "yours") != jobs.new_id("squares")
    assert first != jobs.new_id("cubes", "mine")
    jobs.enqueue("squares", {"count": 3}, first)
    assert jobs.enqueue("squares", {"count": 9}, again).argument == {"count": 3}
    jobs.close()


@pytest.mark.parametrize("fault", [OSError("The object storage refused the request."), StoreFull("It is full.")])
def test_a_storage_that_refuses_for_a_while_is_tried_again_and_an_input_at_fault_is_told(sqlite_url, fault):
    def refuse(_item, _check):
        raise InvalidMask("The mask has no foreground.", part="mask")

    refusing = JobKind("refusing", lambda run, argument: {"all": run.spread("only", [{}])}, {"only": refuse})
    jobs, seen = DbosJobs(sqlite_url), []
    first, second = jobs.new_id("squares"), jobs.new_id("refusing")
    jobs.enqueue("squares", {"count": 3}, first)
    jobs.enqueue("refusing", {}, second)
    with running_worker([squares(seen, (1,), fault), refusing], WorkerOptions(sqlite_url, "a-0")):
        assert awaited(jobs, first).result == {"sum": 5}
        status = awaited(jobs, second)
    assert seen.count(1) == 2
    assert (status.state, status.problem) == (JobState.FAILED, "The mask has no foreground.")
    assert status.problem_kind is KINDS[InvalidMask]
    jobs.close()


def test_cancelling_stops_what_runs_and_what_waits(url):
    entered, ended = threading.Event(), threading.Event()

    def endless(_item, check):
        entered.set()
        try:
            while True:
                check()
                time.sleep(0.01)
        finally:
            ended.set()

    kind = JobKind("endless", lambda run, _: {"all": run.spread("part", [{}] * 5)}, {"part": endless})
    jobs = DbosJobs(url)
    identifier = jobs.new_id("endless")
    jobs.enqueue("endless", {}, identifier)
    with running_worker([kind], WorkerOptions(url, "a-0")):
        assert entered.wait(30.0)
        assert jobs.cancel(identifier).state is JobState.CANCELLED
        assert ended.wait(30.0)
        assert jobs.backlog() == 0
    assert jobs.cancel(identifier).state is JobState.CANCELLED
    jobs.close()


def followers():
    """Threads that follow jobs; those without one end with their worker."""
    return [thread for thread in threading.enumerate() if thread.name.startswith("dbos-executor")]


def test_a_part_that_ends_after_its_job_was_deleted_leaves_nothing(url):
    entered, deleted, forgotten = threading.Event(), threading.Event(), []

    def late(_item, _check):
        entered.set()
        assert deleted.wait(30.0)
        return {}

    kind = JobKind("late", lambda run, _: {"all": run.spread("part", [{}])}, {"part": late}, forgotten.append)
    jobs = DbosJobs(url)
    identifier, other = jobs.new_id("late"), jobs.new_id("late")
    jobs.enqueue("late", {}, identifier)
    with running_worker([kind], WorkerOptions(url, "a-0")):
        assert entered.wait(30.0)
        jobs.cancel(identifier)
        jobs.forget(identifier)
        deleted.set()
        jobs.enqueue("late", {}, other)
        assert awaited(jobs, other).state is JobState.DONE
    assert forgotten == [identifier]
    for thread in followers():
        thread.join(10.0)
        assert not thread.is_alive()
    assert jobs.known([identifier, other]) == {other}
    jobs.close()


def test_a_worker_that_stops_hands_back_what_it_has_not_done(sqlite_url):
    jobs, seen = DbosJobs(sqlite_url), []
    identifier = jobs.new_id("squares")
    jobs.enqueue("squares", {"count": 40}, identifier)
    with running_worker([squares(seen)], WorkerOptions(sqlite_url, "a-0")):
        awaited(jobs, identifier, lambda status: status.done > 2)
    assert len(seen) < 40
    with running_worker([squares(seen)], WorkerOptions(sqlite_url, "b-0")):
        assert awaited(jobs, identifier).state is JobState.DONE
    assert sorted(seen) == list(range(40))
    jobs.close()


KILLED_WORKER = """
import sys, time
from service.adapters.jobs.worker import WorkerOptions, running_worker
from service.job_ports import JobKind
def square(item, check):
    open(sys.argv[2] + "/" + str(item["x"]), "a").write("x")
    time.sleep(0.05)
    return {"y": item["x"] ** 2}
def follow(run, argument):
    run.expect(argument["count"])
    return {"sum": sum(a["y"] for a in run.spread("square", [{"x": x} for x in range(argument["count"])]))}
with running_worker([JobKind("squares", follow, {"square": square})], WorkerOptions(sys.argv[1], sys.argv[3], 2.0)):
    time.sleep(120)
"""


def slow_kind(name, seen, seconds=0.05):
    """Parts of which each takes a while, and tells when it began and ended."""

    def follow(run, argument):
        run.expect(argument["count"])
        return {"all": len(run.spread("part", [{"x": x} for x in range(argument["count"])]))}

    def part(item, _check):
        seen.append((name, item["x"], "begun"))
        time.sleep(seconds)
        seen.append((name, item["x"], "ended"))
        return {}

    return JobKind(name, follow, {"part": part})


def test_a_worker_takes_no_parts_of_kinds_that_it_lacks(url, tmp_path):
    jobs, leases, seen = DbosJobs(url), Leases(url), []
    identifier = jobs.new_id(DRAWING_JOB)
    assert jobs.workers(60.0) == 0
    with subprocess.Popen([sys.executable, "-c", KILLED_WORKER, url, str(tmp_path), "without-0"]) as without:
        try:
            until(lambda: leases.alive(60.0) == 1)
            other = jobs.new_id("squares")
            jobs.enqueue("squares", {"count": 1}, other)
            assert awaited(jobs, other).state is JobState.DONE  # it takes what it has
            with running_worker([slow_kind(DRAWING_JOB, seen, 0.2)], WorkerOptions(url, "with-0")):
                jobs.enqueue(DRAWING_JOB, {"count": 12}, identifier)
                status = awaited(jobs, identifier)
        finally:
            without.kill()
    assert (status.state, status.result, status.problem) == (JobState.DONE, {"all": 12}, None)
    leases.close()
    jobs.close()


def test_parts_of_all_kinds_are_done_one_at_a_time(sqlite_url):
    jobs, seen, names = DbosJobs(sqlite_url), [], (DRAWING_JOB, "others")
    identifiers = [jobs.new_id(name) for name in names]
    for name, identifier in zip(names, identifiers, strict=True):
        jobs.enqueue(name, {"count": 8}, identifier)
    with running_worker([slow_kind(name, seen) for name in names], WorkerOptions(sqlite_url, "a-0")):
        assert {awaited(jobs, identifier).state for identifier in identifiers} == {JobState.DONE}
    assert [step for *_, step in seen] == ["begun", "ended"] * 16
    assert [part for *part, _ in seen[::2]] == [part for *part, _ in seen[1::2]]
    jobs.close()


def test_who_waits_for_a_turn_when_the_worker_ends_never_has_it():
    busy, told = Busy(), []

    def wait():
        try:
            with busy.alone():
                told.append("had it")
        except Ending:
            told.append("ended")

    with busy.alone():
        waiting = threading.Thread(target=wait)
        waiting.start()
        busy.end(0.0)
        waiting.join(10.0)
    assert told == ["ended"]


def test_parts_of_drawings_in_the_queue_of_all_parts_are_done_all_the_same(sqlite_url):
    jobs, seen = DbosJobs(sqlite_url), []
    identifier = jobs.new_id(DRAWING_JOB)
    jobs.enqueue(DRAWING_JOB, {"count": 20}, identifier)
    kinds = [slow_kind(DRAWING_JOB, seen), squares([])]
    with running_worker(kinds, WorkerOptions(sqlite_url, "a-0")):
        awaited(jobs, identifier, lambda status: status.done > 1)
    waiting = jobs.backlog()
    with sqlite3.connect(make_url(sqlite_url).database) as connection:
        moved = connection.execute(
            "UPDATE workflow_status SET queue_name = ? WHERE queue_name = ? AND status = 'ENQUEUED'",
            (PARTS_QUEUE, DRAWING_PARTS_QUEUE),
        )
    connection.close()
    assert moved.rowcount == waiting > 0
    with running_worker(kinds, WorkerOptions(sqlite_url, "b-0")):
        assert awaited(jobs, identifier).state is JobState.DONE
    jobs.close()


@pytest.mark.parametrize("heir", ["gone-0", "other-0"], ids=["it comes back", "another takes over"])
def test_a_killed_worker_loses_nothing(url, tmp_path, heir):
    jobs, seen = DbosJobs(url), []
    identifier = jobs.new_id("squares")
    jobs.enqueue("squares", {"count": 30}, identifier)
    command = [sys.executable, "-c", KILLED_WORKER, url, str(tmp_path), "gone-0"]
    with subprocess.Popen(command) as killed:
        awaited(jobs, identifier, lambda status: status.done > 3)
        killed.kill()
    with running_worker([squares(seen)], WorkerOptions(url, heir, lease_s=2.0)):
        status = awaited(jobs, identifier)
    assert status.result == {"sum": sum(x * x for x in range(30))}
    before = [int(file.name) for file in tmp_path.iterdir() if file.name.isdigit()]
    assert set(before) | set(seen) == set(range(30))
    assert len(set(before) & set(seen)) <= 1
    jobs.close()


def test_leases_run_out(url):
    leases = Leases(url)
    with running_worker([], WorkerOptions(url, "a-0")):
        leases.renew("b-0")
        assert leases.alive(60.0) == 2
        assert list(leases.lost(60.0)) == []
        assert "b-0" in set(leases.lost(-1.0))
        leases.end("b-0")
        assert leases.alive(60.0) == 1
    assert leases.alive(60.0) == 0
    leases.close()


@pytest.mark.parametrize("name", ["\0", "", "nothing", "../x", "{00000000-0000-4000-8000-000000000000}", "\ud800"])
def test_what_is_no_identifier_names_no_job(url, name):
    jobs = DbosJobs(url)
    for ask in (jobs.status, jobs.cancel):
        with pytest.raises(UnknownJob):
            ask(name)
    jobs.close()


def test_a_database_is_made_when_it_is_used_and_not_by_asking_whether_it_is(url):
    jobs = DbosJobs(url)
    assert [is_made(url), is_made(url)] == [False, False]
    jobs.unfinished()
    assert is_made(url)
    jobs.close()


def test_nothing_of_a_database_stays_open(sqlite_url):
    jobs, file = DbosJobs(sqlite_url), make_url(sqlite_url).database
    assert jobs.unfinished() == 0
    assert is_made(sqlite_url)
    jobs.close()
    assert not [link for link in Path("/proc/self/fd").iterdir() if str(link.resolve()).startswith(file)]


def test_a_silent_peer_is_bounded_and_what_an_address_says_stays():
    asked = make_url(bounded("postgresql://user:p%40s@host/name?tcp_user_timeout=1"))
    assert asked.query["tcp_user_timeout"] == "1"
    assert {"connect_timeout", "keepalives_idle", "keepalives_interval", "keepalives_count"} <= set(asked.query)
    assert asked.password == "p@s"
    assert bounded("sqlite:////folder/file") == "sqlite:////folder/file"


def entries(log):
    return [json.loads(line) for line in log.getvalue().splitlines()]


def test_a_database_that_lacks_its_tables_is_a_fault_and_no_wait(postgres_url):
    log = io.StringIO()
    jobs = DbosJobs(postgres_url, make_log("debug", log))
    identifier = jobs.new_id("squares")
    assert jobs.known([identifier]) == set()
    with psycopg.connect(postgres_url, autocommit=True) as connection:
        connection.execute("DROP SCHEMA dbos CASCADE")
    with pytest.raises(ProgrammingError):
        jobs.status(identifier)
    (entry,) = entries(log)
    assert (entry["kind"], entry["state"]) == ("ProgrammingError", "42P01")
    assert identifier not in log.getvalue()
    jobs.close()


def test_a_database_that_is_not_there_is_a_wait():
    log = io.StringIO()
    jobs = DbosJobs(f"postgresql://nobody@127.0.0.1:{free_port()}/of_nobody", make_log("debug", log))
    with pytest.raises(Overloaded):
        jobs.unfinished()
    assert {entry["kind"] for entry in entries(log)} == {"OperationalError"}
    assert "of_nobody" not in log.getvalue()
    jobs.close()


@pytest.fixture
def disk(tmp_path):
    with small_disk(tmp_path / "disk", "2m") as folder:
        yield folder


def enqueue_many(jobs):
    for _ in range(100):
        jobs.enqueue("squares", {"text": "x" * 20_000}, jobs.new_id("squares"))


@pytest.mark.parametrize("opened", [True, False], ids=["while it runs", "from the first"])
def test_a_disk_without_room_takes_no_job_and_takes_one_again_later(disk, opened):
    jobs = DbosJobs(f"sqlite:///{disk / 'folder' / 'jobs.sqlite'}")
    if opened:
        jobs.unfinished()
    ballast = fill(disk)
    with pytest.raises((StoreFull, Overloaded)):
        enqueue_many(jobs)
    ballast.unlink()
    identifier = jobs.new_id("squares")
    assert jobs.enqueue("squares", {"count": 1}, identifier).id == identifier
    jobs.close()


def test_a_full_database_says_that_it_has_no_room(disk):
    jobs = DbosJobs(f"sqlite:///{disk / 'jobs.sqlite'}")
    jobs.unfinished()
    fill(disk)
    with pytest.raises(StoreFull):
        enqueue_many(jobs)
    jobs.close()
