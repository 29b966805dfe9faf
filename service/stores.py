"""Where the settings say that results, files and jobs are kept: on this machine, or in a database and a bucket."""

import socket
from pathlib import Path

from service.adapters.blob_results import BlobResultStore
from service.adapters.blobs import FolderBlobs
from service.adapters.jobs.client import DbosJobs
from service.adapters.result_store import DiskResultStore
from service.extras import require_extra
from service.job_ports import BlobStore
from service.settings import Settings


def jobs_url(settings: Settings) -> str:
    """The jobs' database: the setting's, or a file of SQLite beside the results."""
    given = settings.jobs_database.get_secret_value()
    return given or f"sqlite:///{settings.results_folder.absolute().parent / 'jobs.sqlite'}"


def open_jobs(settings: Settings) -> DbosJobs:
    """The engine of jobs; connects when it is first used."""
    return DbosJobs(jobs_url(settings))


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


def replica_name(settings: Settings) -> str:
    """Name of this machine or container among the others; stable over its restarts."""
    return settings.replica or socket.gethostname()
