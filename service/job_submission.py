"""How something asked for becomes a job: once for each key, within a bound on their number, its inputs kept first."""

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from model.errors import InvalidParameter
from model.inference.annotated_planes import check_stacks
from model.inference.observations import AnnotatedRule, Plane
from service.errors import Overloaded, StoreFull, UnknownJob
from service.job_files import JobFiles
from service.job_ports import BlobStore, JobEngine, JobStatus

#: Member of a job's argument: SHA-256 of everything that was asked for.
_FINGERPRINT = "fingerprint"


@dataclass(frozen=True)
class JobDesk:
    """Takes jobs in.

    Attributes:
        max_jobs: that may wait or run.
    """

    jobs: JobEngine
    blobs: BlobStore
    max_jobs: int

    def submit(
        self, kind: str, argument: Mapping[str, Any], inputs: Sequence[bytes] = (), key: str | None = None
    ) -> JobStatus:
        """Make a job, or find the one that the same key has made.

        Raises:
            InvalidParameter: the key has made a job for another request.
            Overloaded: as many jobs wait or run as may.
            StoreFull: the inputs cannot be kept.
        """
        fingerprint = _fingerprint(argument, inputs)
        identifier = self.jobs.new_id(kind, key)
        found = self._found(identifier) if key is not None else None
        if found is not None:
            if found.argument.get(_FINGERPRINT) != fingerprint:
                raise InvalidParameter(
                    "This key was sent with another request; send a new one.", part="Idempotency-Key"
                )
            return found
        if self.jobs.unfinished() >= self.max_jobs:
            raise Overloaded("As many jobs wait as this service accepts; send the request again later.")
        self._keep(identifier, inputs)
        return self.jobs.enqueue(kind, {**argument, _FINGERPRINT: fingerprint}, identifier)

    def _found(self, identifier: str) -> JobStatus | None:
        try:
            return self.jobs.status(identifier)
        except UnknownJob:
            return None

    def _keep(self, identifier: str, inputs: Sequence[bytes]) -> None:
        files = JobFiles(self.blobs, identifier)
        try:
            for number, data in enumerate(inputs):
                files.put_input(number, data)
        except OSError as fault:
            files.remove()
            raise StoreFull("What was sent cannot be kept now; send the request again later.") from fault


def require_stacks(annotated: AnnotatedRule | Sequence[Plane], count: int) -> None:
    """Refuse planes of stacks that are not there, before anything is read: `InvalidParameter`."""
    if not isinstance(annotated, str):
        check_stacks(annotated, count)


def require_first_stack(annotated: AnnotatedRule | Sequence[Plane], archive: bytes) -> None:
    """Refuse planes of other stacks than the first of each mask of an archive; DICOM objects may have several."""
    with suppress(zipfile.BadZipFile), zipfile.ZipFile(io.BytesIO(archive)) as opened:
        if any(name.lower().endswith(".dcm") for name in opened.namelist()):
            return
    require_stacks(annotated, 1)


def _fingerprint(argument: Mapping[str, Any], inputs: Sequence[bytes]) -> str:
    digest = hashlib.sha256(json.dumps(argument, sort_keys=True).encode())
    for data in inputs:
        digest.update(hashlib.sha256(data).digest())
    return digest.hexdigest()
