"""The jobs' database: SQLite for one machine, PostgreSQL for several; and which executors are alive.

DBOS keeps jobs and their checkpoints in it. Beside its tables stands one of leases: every executor renews its own, and
what one held whose lease has run out is taken over by another.
"""

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import psycopg
import sqlalchemy as sa
from dbos import DBOS, DBOSPortableJSONSerializer
from psycopg.pq import TransactionStatus
from sqlalchemy.engine import make_url

from service.pacs_ports import DRAWING_JOB

#: Of the application in DBOS's records.
APPLICATION = "morphoflow"
#: Of the records, not of the program: releases with the same one take over each other's jobs.
RECORDS_VERSION = "jobs-1"
#: Jobs wait in the first; those that spend their time waiting for archives in the second, so that an archive that is
#: away holds up no other job; the parts that jobs are made of in the third, and those of drawings in the fourth, from
#: which only workers take that know archives.
JOBS_QUEUE, PATIENT_QUEUE, PARTS_QUEUE, DRAWING_PARTS_QUEUE = "jobs", "patient", "parts", "parts of drawings"
#: Queues that are counted with another one.
_BRANCHES = {PARTS_QUEUE: (DRAWING_PARTS_QUEUE,)}
#: Names of the two workflows.
JOB, PART = "job", "part"
#: Schema of DBOS's tables on PostgreSQL.
SCHEMA = "dbos"
#: A connection is there within so long (s), a new one or one that others give back, or the database is away.
CONNECT_S = 3
#: What one statement, and a transaction that does nothing, may take on PostgreSQL (ms); how long its answer is waited
#: for (s), because a server that is gone bounds nothing.
_STATEMENT_MS, _IDLE_MS = 10_000, 60_000
ANSWER_S = 11.0
#: What libpq is told of connections: how long making one takes, and after how long (s, and ms) a peer that has gone
#: without a word is noticed.
_BOUNDS = {
    "connect_timeout": str(CONNECT_S),
    "keepalives_idle": "5",
    "keepalives_interval": "2",
    "keepalives_count": "3",
    "tcp_user_timeout": "6000",
}

_LEASES = sa.Table(
    "morphoflow_leases",
    sa.MetaData(),
    sa.Column("executor", sa.Text, primary_key=True),
    sa.Column("seen_ms", sa.BigInteger, nullable=False),
)
_NOW_MS = {
    "sqlite": "CAST((julianday('now') - 2440587.5) * 86400000 AS INTEGER)",
    "postgresql": "CAST(extract(epoch FROM clock_timestamp()) * 1000 AS BIGINT)",
}


def queue_of(kind: str) -> str:
    """Where jobs of a kind wait."""
    return PATIENT_QUEUE if kind == DRAWING_JOB else JOBS_QUEUE


def parts_queue_of(kind: str) -> str:
    """Where parts of jobs of a kind wait."""
    return DRAWING_PARTS_QUEUE if kind == DRAWING_JOB else PARTS_QUEUE


def json_serializer() -> DBOSPortableJSONSerializer:
    """Records are JSON, so that reading one can run no code."""
    logging.getLogger("dbos").setLevel(logging.CRITICAL)  # faults are logged by who meets them
    return DBOSPortableJSONSerializer()


def prepare(url: str) -> None:
    """Make the database's file and tables, or bring them to this release's form."""
    parsed = make_url(url)
    if parsed.get_backend_name() == "sqlite" and parsed.database:
        file = Path(parsed.database)
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with closing(sqlite3.connect(file, timeout=30.0)) as connection:
            connection.execute("PRAGMA journal_mode=WAL")  # readers do not wait for writers; stays with the file
        file.chmod(0o600)
    DBOS.migrate(bounded(url), schema=SCHEMA)
    engine = open_engine(url)
    try:
        _LEASES.create(engine, checkfirst=True)
    except sa.exc.DBAPIError:  # another replica was faster
        if not sa.inspect(engine).has_table(_LEASES.name):
            raise
    finally:
        engine.dispose()


def is_made(url: str) -> bool:
    """Whether `prepare` has ever been there, as far as the database says; makes nothing."""
    if not is_postgres(url) and not Path(make_url(url).database or "").is_file():
        return False
    engine = open_engine(url)
    try:
        return sa.inspect(engine).has_table(_LEASES.name)
    except sa.exc.DBAPIError:  # it is away, which whoever asks it next is told
        return True
    finally:
        engine.dispose()


def is_postgres(url: str) -> bool:
    """Whether the database is one of several machines."""
    return make_url(url).get_backend_name() != "sqlite"


def bounded(url: str) -> str:
    """The address with bounds on how long a network or a server may be silent, less those that it has already."""
    parsed = make_url(url)
    missing = {name: bound for name, bound in _BOUNDS.items() if name not in parsed.query}
    if not is_postgres(url) or not missing:
        return url
    return parsed.update_query_dict(missing).render_as_string(hide_password=False)


class _Answering(psycopg.Connection[Any]):
    """A connection that fails, and is closed, when an answer takes longer than `ANSWER_S`."""

    def wait(self, gen: Any, interval: float = 0.1, timeout: float | None = ANSWER_S) -> Any:
        try:
            return super().wait(gen, interval, timeout)
        except psycopg.OperationalError:
            if self.pgconn.transaction_status == TransactionStatus.ACTIVE:
                self.close()
            raise


def open_engine(url: str, connections: int = 2) -> sa.Engine:
    """Connections of this project's own; none is waited for longer than `CONNECT_S`, no answer than `ANSWER_S`."""
    if not is_postgres(url):
        return sa.create_engine(url, connect_args={"timeout": 30.0})
    engine = sa.create_engine(
        make_url(bounded(url)).set(drivername="postgresql+psycopg"),
        pool_size=connections,
        max_overflow=0,
        pool_timeout=CONNECT_S,
        pool_pre_ping=True,
    )
    sa.event.listen(engine, "do_connect", _connect)
    sa.event.listen(engine, "connect", _bound_statements)
    return engine


def _connect(_dialect: object, _record: object, arguments: Any, named: Any) -> _Answering:
    return _Answering.connect(*arguments, **named)


def _bound_statements(connection: Any, _record: object) -> None:
    """Set here and not while connecting, where a pooler between may refuse it."""
    with connection.cursor() as cursor:
        cursor.execute(f"SET statement_timeout = {_STATEMENT_MS}")
        cursor.execute(f"SET idle_in_transaction_session_timeout = {_IDLE_MS}")
    connection.commit()  # the pool rolls back what is not


class Leases:
    """Which executors are alive, by the database's own clock."""

    def __init__(self, url: str) -> None:
        self._engine = open_engine(url)
        self._now = sa.literal_column(_NOW_MS[self._engine.dialect.name], sa.BigInteger)

    def renew(self, executor: str) -> None:
        """This executor is alive."""
        with self._engine.begin() as connection:
            renewed = connection.execute(
                sa.update(_LEASES).where(_LEASES.c.executor == executor).values(seen_ms=self._now)
            )
            if renewed.rowcount == 0:
                connection.execute(sa.insert(_LEASES).values(executor=executor, seen_ms=self._now))

    def lost(self, lease_s: float) -> Iterator[str]:
        """Executors that have not been seen for so long."""
        query = sa.select(_LEASES.c.executor).where(_LEASES.c.seen_ms < self._now - int(lease_s * 1000))
        with self._engine.connect() as connection:
            yield from connection.execute(query).scalars().all()

    def alive(self, lease_s: float) -> int:
        """How many executors have been seen since."""
        query = sa.select(sa.func.count()).where(_LEASES.c.seen_ms >= self._now - int(lease_s * 1000))
        with self._engine.connect() as connection:
            return int(connection.execute(query).scalar_one())

    def lapse(self, executor: str) -> None:
        """This executor is gone; the next that asks takes over what it may still hold."""
        with self._engine.begin() as connection:
            connection.execute(sa.update(_LEASES).where(_LEASES.c.executor == executor).values(seen_ms=0))

    def end(self, executor: str) -> None:
        """This executor is gone and holds nothing."""
        with self._engine.begin() as connection:
            connection.execute(sa.delete(_LEASES).where(_LEASES.c.executor == executor))

    def count(self, queue: str, *states: str) -> int:
        """Workflows of a queue, and of those that branch off it, in one of the states."""
        schema = None if self._engine.dialect.name == "sqlite" else SCHEMA
        table = sa.table("workflow_status", sa.column("queue_name"), sa.column("status"), schema=schema)
        query = sa.select(sa.func.count()).select_from(table)
        queues = (queue, *_BRANCHES.get(queue, ()))
        query = query.where(table.c.queue_name.in_(queues), table.c.status.in_(states))
        with self._engine.connect() as connection:
            return int(connection.execute(query).scalar_one())

    def close(self) -> None:
        """Let go of the connections."""
        self._engine.dispose()
