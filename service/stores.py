"""Where the settings say that results, files and jobs are kept: on this machine, or in a database and a bucket."""

import os
import socket
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.engine import make_url

from model.errors import InvalidParameter
from service.adapters.blob_results import BlobResultStore
from service.adapters.blobs import FolderBlobs
from service.adapters.jobs.client import DbosJobs
from service.adapters.jobs.database import is_made, is_postgres, open_engine
from service.adapters.result_store import DiskResultStore
from service.errors import UnknownJob
from service.extras import require_extra
from service.job_ports import BlobStore
from service.observability import Log
from service.settings import Settings

#: How a file of SQLite begins.
_SQLITE = b"SQLite format 3\0"


def jobs_url(settings: Settings) -> str:
    """The jobs' database: the setting's, or a file of SQLite beside the results."""
    given = settings.jobs_database.get_secret_value()
    return given or f"sqlite:///{settings.results_folder.absolute().parent / 'jobs.sqlite'}"


def open_jobs(settings: Settings, log: Log | None = None) -> DbosJobs:
    """The engine of jobs; connects when it is first used."""
    return DbosJobs(jobs_url(settings), log)


def open_blobs(settings: Settings) -> BlobStore:
    """Files of jobs: a bucket where one is set, else a folder beside the results."""
    if settings.storage_url:
        require_extra("cluster", needed_by="MORPHOFLOW_STORAGE_URL")
        from service.adapters.s3 import S3Blobs

        return S3Blobs(settings.storage_url, settings.storage_endpoint or None)
    return FolderBlobs(settings.results_folder.absolute().parent / "files")


def open_results(settings: Settings, blobs: BlobStore) -> DiskResultStore | BlobResultStore:
    """Results of reconstructions: in the bucket where one is set, else in their folder."""
    if settings.storage_url:
        return BlobResultStore(blobs, lifetime_s=settings.result_lifetime_s)
    folder: Path = settings.results_folder
    return DiskResultStore(folder, lifetime_s=settings.result_lifetime_s, max_bytes=settings.results_max_bytes)


def require_places(settings: Settings) -> None:
    """Refuse places that nothing can be kept in; one that is only away for now is waited for while the program runs.

    Raises:
        InvalidParameter: names the setting and says what it may be.
    """
    if not settings.storage_url and not _is_writable(settings.results_folder):
        raise InvalidParameter(
            "MORPHOFLOW_RESULTS_FOLDER must name a folder that this program may make or write to.",
            part="results_folder",
        )
    open_blobs(settings)  # refuses storage that no client can be made for
    url = jobs_url(settings)
    _require_on_server(url)
    if not is_postgres(url) and not _may_hold_jobs(_file_of(url)):
        raise _no_place_for_jobs(settings)


def require_jobs(settings: Settings) -> None:
    """Refuse to ask for a job where none has ever been kept; nothing is made by this.

    Raises:
        InvalidParameter: names the setting and says what it may be.
        UnknownJob: no database of jobs has been made.
    """
    url = jobs_url(settings)
    _require_on_server(url)
    if not is_postgres(url) and _file_of(url).exists() and not _is_sqlite(_file_of(url)):
        raise _no_place_for_jobs(settings)
    if not is_made(url):
        raise UnknownJob("There is no job of this identifier: no jobs have been kept where the settings say.")


def _require_on_server(url: str) -> None:
    name = missing_database(url)
    if name is not None:
        raise InvalidParameter(
            f"MORPHOFLOW_JOBS_DATABASE names the database {name}, which is not on its server; create it first.",
            part="jobs_database",
        )


def _no_place_for_jobs(settings: Settings) -> InvalidParameter:
    if settings.jobs_database.get_secret_value():
        sentence = "MORPHOFLOW_JOBS_DATABASE must name a file of SQLite that this program may make or write to."
        return InvalidParameter(sentence, part="jobs_database")
    return InvalidParameter(
        "MORPHOFLOW_RESULTS_FOLDER must lie in a folder where this program may make or write to the file jobs.sqlite; "
        "or name a database with MORPHOFLOW_JOBS_DATABASE.",
        part="results_folder",
    )


def _file_of(url: str) -> Path:
    return Path(make_url(url).database or "")


def _may_hold_jobs(file: Path) -> bool:
    if not _is_writable(file.parent):
        return False
    return not file.exists() or (_is_sqlite(file) and os.access(file, os.W_OK))


def _is_sqlite(file: Path) -> bool:
    """Whether a file is one of SQLite; an empty one becomes one."""
    try:
        with file.open("rb") as opened:
            return opened.read(len(_SQLITE)) in (_SQLITE, b"")
    except OSError:
        return False


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.R_OK | os.W_OK | os.X_OK)


def missing_database(url: str) -> str | None:
    """Name of a database that its server says it does not have; None when it has, or does not say."""
    place = make_url(url)
    if not is_postgres(url):
        return None
    everywhere = open_engine(place.set(database="postgres").render_as_string(hide_password=False))
    query = sa.text("SELECT 1 FROM pg_database WHERE datname = :name")
    try:
        with everywhere.connect() as connection:
            return None if connection.execute(query, {"name": place.database}).first() else place.database
    except sa.exc.DBAPIError:
        return None
    finally:
        everywhere.dispose()


def replica_name(settings: Settings) -> str:
    """Name of this machine or container among the others; stable over its restarts."""
    return settings.replica or socket.gethostname()
