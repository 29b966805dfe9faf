"""The databases that jobs are tested on: SQLite always, PostgreSQL where one listens on this machine."""

import os
import uuid
from collections.abc import Iterator

import psycopg
import pytest

POSTGRES = os.environ.get("MORPHOFLOW_TEST_POSTGRES", "postgresql://postgres@127.0.0.1:5432")


@pytest.fixture
def sqlite_url(tmp_path):
    return f"sqlite:///{tmp_path / 'jobs.sqlite'}"


@pytest.fixture
def postgres_url() -> Iterator[str]:
    name = f"jobs_{uuid.uuid4().hex}"
    try:
        connection = psycopg.connect(f"{POSTGRES}/postgres", autocommit=True, connect_timeout=2)
    except psycopg.OperationalError:
        pytest.skip("no PostgreSQL on this machine (MORPHOFLOW_TEST_POSTGRES)")
    connection.execute(f"CREATE DATABASE {name}")
    yield f"{POSTGRES}/{name}"
    connection.execute(f"DROP DATABASE {name} WITH (FORCE)")
    connection.close()


@pytest.fixture(params=["sqlite_url", "postgres_url"])
def url(request) -> str:
    return request.getfixturevalue(request.param)
