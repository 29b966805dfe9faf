"""Where commands keep results and jobs: what they refuse before any work, and what they never make."""

import subprocess
import sys

import psycopg
import pytest

from benchmarks.ports import free_port
from service.adapters.jobs.client import DbosJobs
from service.cli import BAD_INPUT, main
from service.model_registry import ModelRegistry
from service.pacs_ports import DRAWING_JOB
from service.ports import RECONSTRUCTION_JOB
from service.stores import missing_database
from tests.analytic_model import ellipsoid_model
from tests.service_parts import NAME


def run(*words):
    return main(list(words), lambda _: ModelRegistry({NAME: ellipsoid_model(NAME)}))


@pytest.mark.parametrize("words", [("serve",), ("worker",), ("jobs", "sample")])
@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("RESULTS_FOLDER", "/proc/absent/results"),
        ("RESULTS_FOLDER", "/proc/version"),
        ("RESULT_LIFETIME_S", "inf"),
        ("JOBS_DATABASE", "mysql://user:hush@host/name"),
        ("JOBS_DATABASE", "sqlite:///:memory:"),
        ("JOBS_DATABASE", "sqlite:////proc/absent/jobs.sqlite"),
        ("JOBS_DATABASE", "sqlite:////proc/version"),
        ("JOBS_DATABASE", "sqlite:////tmp"),
        ("STORAGE_URL", "gs://bucket"),
    ],
)
def test_what_nothing_can_be_kept_in_is_refused_at_the_start(words, setting, value, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MORPHOFLOW_RESULTS_FOLDER", str(tmp_path / "results"))
    monkeypatch.setenv(f"MORPHOFLOW_{setting}", value)
    assert run(*words) == BAD_INPUT
    told = capsys.readouterr().err
    assert setting in told.upper()
    assert value not in told
    assert told.count("\n") == 1


@pytest.mark.parametrize("word", ["serve", "worker"])
def test_a_database_that_is_not_there_is_named_and_not_made(word, postgres_url, tmp_path, capsys, monkeypatch):
    name = "absent_" + postgres_url.rpartition("_")[2]
    monkeypatch.setenv("MORPHOFLOW_RESULTS_FOLDER", str(tmp_path / "results"))
    monkeypatch.setenv("MORPHOFLOW_JOBS_DATABASE", f"{postgres_url.rpartition('/')[0]}/{name}")
    assert run(word) == BAD_INPUT
    assert f"the database {name}, which is not on its server" in capsys.readouterr().err
    with psycopg.connect(postgres_url) as connection:
        assert not connection.execute("SELECT 1 FROM pg_database WHERE datname = %s", [name]).fetchall()
    assert missing_database(postgres_url) is None


ASKING = [("jobs", word, "11111111-1111-4111-8111-111111111111") for word in ("watch", "cancel")]


@pytest.mark.parametrize("words", ASKING)
def test_who_only_asks_for_a_job_makes_no_database(words, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MORPHOFLOW_RESULTS_FOLDER", str(tmp_path / "state" / "results"))
    assert run(*words) == BAD_INPUT
    assert capsys.readouterr().err.startswith("morphoflow: There is no job of this identifier")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", ASKING)
def test_who_only_asks_for_a_job_makes_no_tables(words, postgres_url, capsys, monkeypatch):
    monkeypatch.setenv("MORPHOFLOW_JOBS_DATABASE", postgres_url)
    assert run(*words) == BAD_INPUT
    assert "no job of this identifier" in capsys.readouterr().err
    with psycopg.connect(postgres_url) as connection:
        tables = "SELECT 1 FROM pg_tables WHERE schemaname NOT IN ('pg_catalog', 'information_schema')"
        assert not connection.execute(tables).fetchall()


@pytest.mark.parametrize("words", ASKING)
def test_who_asks_for_a_job_in_what_is_no_database_is_told_so(words, tmp_path, capsys, monkeypatch):
    (tmp_path / "jobs.sqlite").write_text("no database at all")
    monkeypatch.setenv("MORPHOFLOW_JOBS_DATABASE", f"sqlite:///{tmp_path / 'jobs.sqlite'}")
    assert run(*words) == BAD_INPUT
    assert "MORPHOFLOW_JOBS_DATABASE" in capsys.readouterr().err


def test_a_server_that_does_not_answer_is_not_one_without_the_database():
    assert missing_database(f"postgresql://user@127.0.0.1:{free_port()}/jobs") is None


DONE_AT_ONCE = """
import sys, time
from service.adapters.jobs.client import DbosJobs
from service.adapters.jobs.worker import WorkerOptions, running_worker
from service.job_ports import JobKind
url, kind, identifier = sys.argv[1:]
jobs = DbosJobs(url)
with running_worker([JobKind(kind, lambda run, _: {kind: run.id}, {})], WorkerOptions(url, "a-0")):
    while not jobs.status(identifier).state.is_final:
        time.sleep(0.1)
jobs.close()
"""


@pytest.mark.parametrize("kind", [RECONSTRUCTION_JOB, DRAWING_JOB])
def test_a_job_that_makes_no_zip_is_followed_and_fills_no_file(kind, url, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MORPHOFLOW_RESULTS_FOLDER", str(tmp_path / "state" / "results"))
    monkeypatch.setenv("MORPHOFLOW_JOBS_DATABASE", url)
    jobs, target = DbosJobs(url), tmp_path / "all.zip"
    identifier = jobs.new_id(kind)
    jobs.enqueue(kind, {}, identifier)
    output = ("--output", str(target))
    jobs.close()
    subprocess.run([sys.executable, "-c", DONE_AT_ONCE, url, kind, identifier], check=True, timeout=60.0)
    assert run("jobs", "watch", identifier, *output) == BAD_INPUT
    (told,) = capsys.readouterr().err.splitlines()
    assert "--output accepts a job of kind samples or reconstructions" in told
    assert not target.exists()
    assert run("jobs", "watch", identifier) == 0
