"""How something asked for becomes a job: once for each key, within a bound on their number, its inputs kept first."""

import hashlib
import json
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, BinaryIO

from model.errors import InvalidParameter
from model.inference.annotated_planes import check_stacks
from model.inference.observations import AnnotatedRule, Plane
from service.errors import Overloaded, StoreFull, UnknownJob
from service.job_archives import ArchiveLimits, masks_of, open_archive
from service.job_files import JobFiles
from service.job_ports import BlobStore, JobEngine, JobStatus

#: Bytes of what was sent that are in memory at the same time.
_PIECE = 1 << 20
#: Member of a job's argument: SHA-256 of everything that was asked for.
_FINGERPRINT = "fingerprint"
#: A key is one client's for requests of all kinds.
_ANY_KIND = "request"
#: Member of a job's argument: whose inputs are the job's. Empty where no other request can want the same job, and not
#: there in records of earlier releases.
SUBMISSION = "submission"


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
        self,
        kind: str,
        asked: Mapping[str, Any],
        inputs: Sequence[BinaryIO] = (),
        key: str | None = None,
        *,
        model: str,
    ) -> JobStatus:
        """Make a job, or find the one that the same key has made for the same request.

        Args:
            asked: the job's argument with the model as it was asked for, which a later release of it leaves as it is.
            inputs: what was sent with it; read from its beginning, and may be closed by this.
            model: the one that the job is given to.

        Raises:
            InvalidParameter: the key has made a job for another request.
            Overloaded: as many jobs wait or run as may.
            StoreFull: the inputs, or the job, cannot be kept; nothing is left of them.
        """
        if (earlier := self.earlier(kind, asked, inputs, key)) is not None:
            return earlier
        fingerprint, identifier = _fingerprint(kind, asked, inputs), self.jobs.new_id(_ANY_KIND, key)
        if self.jobs.unfinished() >= self.max_jobs:
            raise Overloaded("As many jobs wait as this service accepts; send the request again later.")
        submission = "" if key is None else uuid.uuid4().hex
        self._keep(identifier, inputs, submission)
        argument = {**asked, "model": model, _FINGERPRINT: fingerprint, SUBMISSION: submission}
        try:
            made = self.jobs.enqueue(kind, argument, identifier)
        except StoreFull:  # there is no job; of other faults that is not known
            self._let_go(identifier, submission)
            raise
        if made.argument.get(SUBMISSION, "") != submission:  # another request of the same key was faster
            self._let_go(identifier, submission)
        return _of_same_request(made, fingerprint)

    def earlier(
        self, kind: str, asked: Mapping[str, Any], inputs: Sequence[BinaryIO] = (), key: str | None = None
    ) -> JobStatus | None:
        """The job that the same key has made for the same request, whatever could be made of it now; None without one.

        Raises:
            InvalidParameter: the key has made a job for another request.
        """
        found = None if key is None else self._found(self.jobs.new_id(_ANY_KIND, key))
        return None if found is None else _of_same_request(found, _fingerprint(kind, asked, inputs))

    def _found(self, identifier: str) -> JobStatus | None:
        try:
            return self.jobs.status(identifier)
        except UnknownJob:
            return None

    def _keep(self, identifier: str, inputs: Sequence[BinaryIO], submission: str) -> None:
        files = JobFiles(self.blobs, identifier)
        try:
            for number, file in enumerate(inputs):
                files.put_input(number, file, submission)
        except OSError as fault:
            self._let_go(identifier, submission)
            raise StoreFull("What was sent cannot be kept now; send the request again later.") from fault

    def _let_go(self, identifier: str, submission: str) -> None:
        with suppress(OSError):  # of a storage that is away; what stays is found to be astray later
            JobFiles(self.blobs, identifier).remove_inputs(submission)


def require_stacks(annotated: AnnotatedRule | Sequence[Plane], count: int) -> None:
    """Refuse planes of stacks that are not there, before anything is read: `InvalidParameter`."""
    if not isinstance(annotated, str):
        check_stacks(annotated, count)


def require_archive(archive: BinaryIO, annotated: AnnotatedRule | Sequence[Plane], limits: ArchiveLimits) -> None:
    """Refuse an archive that cannot be unpacked, before a job is made of it.

    Raises:
        InvalidParameter: no ZIP, or planes of other stacks than the first of each mask; DICOM objects may have several.
        TooLarge: more masks than a job may have, or larger ones.
    """
    with open_archive(archive, limits) as opened:
        names = [info.filename.lower() for info in masks_of(opened, limits)]
    if not any(name.endswith(".dcm") for name in names):
        require_stacks(annotated, 1)


def _of_same_request(found: JobStatus, fingerprint: str) -> JobStatus:
    """The job, if it was made for the request of this fingerprint."""
    if found.argument.get(_FINGERPRINT) != fingerprint:
        raise InvalidParameter("This key was sent with another request; send a new one.", part="Idempotency-Key")
    return found


def _fingerprint(kind: str, asked: Mapping[str, Any], inputs: Sequence[BinaryIO]) -> str:
    digest = hashlib.sha256(json.dumps([kind, asked], sort_keys=True).encode())
    for file in inputs:
        digest.update(_digest(file))
    return digest.hexdigest()


def _digest(file: BinaryIO) -> bytes:
    file.seek(0)
    digest = hashlib.sha256()
    while piece := file.read(_PIECE):
        digest.update(piece)
    return digest.digest()
