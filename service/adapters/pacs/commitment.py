"""Storage commitment (PS3.4, J): what archives were asked, and what they report, as files that outlive every process.

An archive reports when it pleases, to the listener; the job of a drawing looks for the report in each of its turns.
Reports of what nobody asked for are not kept.
"""

import hashlib
import json
from dataclasses import asdict, dataclass, replace

from pydicom.uid import generate_uid

from service.job_ports import BlobStore

COMMITMENTS = "dicom/commitments"
#: Requests whose reports are still taken; an archive that never reports is asked again and again.
REMEMBERED = 8


@dataclass(frozen=True)
class Report:
    """What an archive says on one request.

    Attributes:
        failed: SOP Instance UIDs of the objects that it does not commit itself to; None for all of them.
    """

    failed: frozenset[str] | None = frozenset()

    @property
    def is_success(self) -> bool:
        """Whether it has committed itself to everything."""
        return self.failed is not None and not self.failed


class Reports:
    """Requests that were made and their reports, by Transaction UID."""

    def __init__(self, blobs: BlobStore) -> None:
        self._blobs = blobs

    def expect(self, transaction: str) -> None:
        """A request is about to be made."""
        self._blobs.put(f"{_folder(transaction)}/asked", b"")

    def take(self, transaction: str, report: Report) -> bool:
        """Keep a report; False when it was not asked for, or not any more."""
        if not self._blobs.exists(f"{_folder(transaction)}/asked"):
            return False
        failed = None if report.failed is None else sorted(report.failed)
        self._blobs.put(f"{_folder(transaction)}/report", json.dumps({"failed": failed}).encode())
        return True

    def find(self, transaction: str) -> Report | None:
        """The report, if it has come."""
        try:
            content = self._blobs.get(f"{_folder(transaction)}/report")
        except FileNotFoundError:
            return None
        failed = json.loads(content)["failed"]
        return Report(None if failed is None else frozenset(failed))

    def forget(self, transaction: str) -> None:
        """Nothing more is wanted of a request."""
        self._blobs.delete(f"{_folder(transaction)}/")


@dataclass(frozen=True)
class Progress:
    """How far an archive is with the results of one drawing.

    Attributes:
        transactions: Transaction UIDs of requests that may still be reported on, the newest last.
        is_sent: whether the newest was taken by the archive.
        asked_s: when it was (seconds since 1970).
        is_committed: whether the archive has committed itself.
    """

    transactions: tuple[str, ...] = ()
    is_sent: bool = False
    asked_s: float = 0.0
    is_committed: bool = False


class Requests:
    """The requests to one archive on the results of one drawing; each change is on disk before it has effects.

    Args:
        key: the file that holds how far they are.
    """

    def __init__(self, blobs: BlobStore, key: str) -> None:
        self._blobs, self._key = blobs, key
        self._reports = Reports(blobs)
        self.progress = _read(blobs, key)

    def report(self) -> Report | None:
        """The report of the newest request, or the success of an older one; None while there is neither."""
        found = [self._reports.find(transaction) for transaction in self.progress.transactions]
        if any(report is not None and report.is_success for report in found):
            return Report()
        return found[-1] if found else None

    def is_awaited(self, now_s: float, patience_s: float) -> bool:
        """Whether the newest request was made and may still be answered."""
        return self.progress.is_sent and now_s - self.progress.asked_s < patience_s

    def begin(self) -> str:
        """Transaction UID of the request to make: a new one, unless the archive may not have got the newest."""
        pending = self.progress.transactions
        unanswered = [transaction for transaction in pending if self._reports.find(transaction) is None]
        if self.progress.is_sent or not unanswered or unanswered[-1] != pending[-1]:
            kept = tuple(unanswered[1 - REMEMBERED :])
            self._put(Progress((*kept, str(generate_uid(None)))))
            for transaction in set(pending) - set(kept):
                self._reports.forget(transaction)
        transaction = self.progress.transactions[-1]
        self._reports.expect(transaction)
        return transaction

    def sent(self, now_s: float) -> None:
        """The archive has taken the newest request."""
        self._put(replace(self.progress, is_sent=True, asked_s=now_s))

    def end(self) -> None:
        """The archive has committed itself."""
        self.forget()
        self._put(Progress(is_committed=True))

    def forget(self) -> None:
        """Reports that may still come are not wanted any more."""
        for transaction in self.progress.transactions:
            self._reports.forget(transaction)

    def _put(self, progress: Progress) -> None:
        self._blobs.put(self._key, json.dumps(asdict(progress)).encode())
        self.progress = progress


def _read(blobs: BlobStore, key: str) -> Progress:
    try:
        found = json.loads(blobs.get(key))
    except FileNotFoundError:
        return Progress()
    return Progress(**{**found, "transactions": tuple(found["transactions"])})


def _folder(transaction: str) -> str:
    return f"{COMMITMENTS}/{hashlib.sha256(transaction.encode()).hexdigest()}"
