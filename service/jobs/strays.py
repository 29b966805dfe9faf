"""Files of jobs that have no record: a worker was killed over a deleted job, or a service over one to be made."""

import time
from collections.abc import Callable

from model.interruption import Check, unchecked
from service.job_files import JobFiles, jobs_with_files
from service.job_ports import BlobStore, JobEngine

#: Files are there before their job is: only what had no record at two looks so far apart (s) is astray.
LOOK_EVERY_S = 600.0


class Strays:
    """Finds and removes them."""

    def __init__(self, jobs: JobEngine, blobs: BlobStore, clock: Callable[[], float] = time.monotonic) -> None:
        self._jobs = jobs
        self._blobs = blobs
        self._clock = clock
        self._looked_at = clock()
        self._suspects: set[str] = set()

    def sweep(self, check: Check = unchecked) -> int:
        """Remove what was astray at the last look and still is, if it is time; how many jobs' files.

        What the check raises ends it before the next piece of files.
        """
        if self._clock() < self._looked_at + LOOK_EVERY_S:
            return 0
        self._looked_at = self._clock()
        there = set(jobs_with_files(self._blobs))
        astray = there - self._jobs.known(there)
        gone = astray & self._suspects
        for job in gone:
            JobFiles(self._blobs, job).remove(check)
        self._suspects = astray - gone
        return len(gone)
