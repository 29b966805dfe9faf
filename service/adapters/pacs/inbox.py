"""What was received: on disk and in a durable job before anybody is told so; or in quarantine, with the reason.

Files are named by digests: no name, number or date of a patient is in them.
"""

import hashlib
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count, islice
from typing import Any

from pydicom import Dataset

from model.errors import InputError
from service.adapters.dicom.objects import read_object, tolerant
from service.adapters.pacs.audit import AuditEntry, AuditEvent, AuditTrail, Outcome
from service.adapters.pacs.configuration import Rule
from service.adapters.pacs.headers import Header, header_of
from service.adapters.pacs.routing import Match, find_rule
from service.errors import UnknownJob
from service.job_ports import BlobStore, JobEngine, JobStatus, Record
from service.pacs_ports import DRAWING_JOB, Disposition, Receipt

INBOX, QUARANTINE = "dicom/inbox", "dicom/quarantine"
#: Files of one received object.
OBJECT, ARGUMENT, IMAGES, REASON = "object.dcm", "job.json", "images.json", "reason.json"
#: Jobs of one drawn structure that are asked for at once.
JOBS_AT_ONCE = 32


@dataclass(frozen=True)
class Inbox:
    """The `ObjectReceiver`.

    Attributes:
        rules: in the order in which they are asked.
        title: of this program in the audit trail.
        log: takes events without identifiers.
    """

    rules: tuple[Rule, ...]
    blobs: BlobStore
    jobs: JobEngine
    audit: AuditTrail
    title: str
    log: Any

    def receive(self, data: bytes, sender: str, study: str | None = None) -> Receipt:
        """Take one object; see `ObjectReceiver`."""
        header = header_of(data)
        if study is not None and header.study not in ("", study):
            return self._misplaced(header, sender)
        if header.is_foreign:
            return self._taken(header, sender, None)
        receipt, _ = self._take(data, sender, sender)
        return receipt

    def send_again(self, name: str) -> Disposition:
        """Take an object in quarantine once more, as if its sender had sent it again; by the name of its folder.

        Raises:
            FileNotFoundError: none of that name is in quarantine.
        """
        data = self.blobs.get(f"{QUARANTINE}/{name}/{OBJECT}")
        told = json.loads(self.blobs.get(f"{QUARANTINE}/{name}/{REASON}"))
        receipt, drawings = self._take(data, told.get("sender", ""), self.title, name)
        if receipt.disposition is Disposition.ACCEPTED and name not in drawings:  # by a rule of another name
            self.blobs.delete(f"{QUARANTINE}/{name}/")
        return receipt.disposition

    def _take(self, data: bytes, sender: str, source: str, only: str | None = None) -> tuple[Receipt, list[str]]:
        """Make a job of each structure that a rule takes; their names in quarantine, should they come to be there.

        Args:
            sender: whom the rules ask about.
            source: who gave the object, in the audit trail.
            only: name in quarantine of the structure that is meant; all are when it is of none.
        """
        try:
            found = read_object(io.BytesIO(data), "object")
            with tolerant("object"):
                named = (str(found.SOPClassUID), str(found.SOPInstanceUID), str(found.StudyInstanceUID))
            match = find_rule(self.rules, found, sender)
        except InputError as error:
            return self._quarantine(data, sender, source, error), []
        drawings = []
        if match is not None:
            for labels, digest in self._meant(found, match, only):
                drawings.append(self._accept(data, digest, match.rule, labels, sender))
        return self._taken(Header(*named, is_foreign=match is None), source, match), drawings

    def _meant(self, found: Dataset, match: Match, only: str | None) -> list[tuple[frozenset[int] | None, str]]:
        """Numbers and digests of the structures that are taken."""
        structures = list(zip(match.structures, drawing_digests(found, match), strict=True))
        return [pair for pair in structures if self.jobs.new_id(DRAWING_JOB, pair[1]) == only] or structures

    def take_up(self) -> None:
        """Make jobs of what a killed service had written down and not enqueued; its sender was not told anything."""
        for key in list(self.blobs.list(f"{INBOX}/")):
            identifier, _, name = key.removeprefix(f"{INBOX}/").partition("/")
            if name == ARGUMENT and not self._is_in_a_job(identifier):
                self.jobs.enqueue(DRAWING_JOB, json.loads(self.blobs.get(key)), identifier)

    def backlog(self) -> int:
        """Structures of accepted objects that are not given back yet."""
        return len({key.split("/")[2] for key in self.blobs.list(f"{INBOX}/")})

    def quarantined(self) -> int:
        """Objects in quarantine."""
        return len(self.in_quarantine())

    def in_quarantine(self) -> list[str]:
        """Names of the folders in quarantine."""
        return sorted({key.split("/")[2] for key in self.blobs.list(f"{QUARANTINE}/")})

    def _taken(self, header: Header, source: str, match: Match | None) -> Receipt:
        disposition = Disposition.LEFT_ALONE if match is None else Disposition.ACCEPTED
        note = "" if match else "No rule takes it; it was left alone."
        uids = (header.sop_class, header.sop_instance)
        self.audit.write(AuditEntry(AuditEvent.RECEIVED, source, self.title, header.study, [uids], note=note))
        self.log.info("object received", disposition=disposition.value, rule=match.rule.name if match else None)
        return Receipt(disposition, *uids)

    def _misplaced(self, header: Header, sender: str) -> Receipt:
        uids, note = (header.sop_class, header.sop_instance), "It is not of the study that was named; it was not kept."
        failure = Outcome.MINOR_FAILURE
        self.audit.write(AuditEntry(AuditEvent.RECEIVED, sender, self.title, header.study, [uids], failure, note))
        self.log.warning("object received", disposition=Disposition.MISPLACED.value)
        return Receipt(Disposition.MISPLACED, *uids)

    def _accept(self, data: bytes, digest: str, rule: Rule, labels: frozenset[int] | None, sender: str) -> str:
        """On disk first, then the job; what a job waits for or is at work on is left to it.

        Returns:
            The name of the drawn structure in quarantine.
        """
        drawing = self.jobs.new_id(DRAWING_JOB, digest)
        earlier, identifier = self._jobs_of(digest)
        if earlier and not self._has_ended(earlier[-1]):
            return drawing
        argument: Record = {
            "object": identifier,
            "drawing": drawing,
            "rule": rule.name,
            "labels": None if labels is None else sorted(labels),
            "sender": sender,
            "send_to": list(rule.send_to),
        }
        self.blobs.put(f"{INBOX}/{identifier}/{OBJECT}", data)
        self.blobs.put(f"{INBOX}/{identifier}/{ARGUMENT}", json.dumps(argument).encode())
        self.jobs.enqueue(DRAWING_JOB, argument, identifier)
        self._release(drawing, earlier)
        return drawing

    def _identifiers(self, digest: str) -> Iterator[str]:
        """Of the first job of a drawn structure, and of those that follow when it is sent again."""
        yield self.jobs.new_id(DRAWING_JOB, digest)
        for number in count(2):
            yield self.jobs.new_id(DRAWING_JOB, f"{digest}\n{number}")

    def _jobs_of(self, digest: str) -> tuple[list[str], str]:
        """The jobs of a drawn structure so far, and the identifier of the one to come.

        Records of the first ones may have expired while the last one still waits for an archive.
        """
        earlier: list[str] = []
        coming = ""
        for identifier, is_known in self._known(self._identifiers(digest)):
            if is_known:
                earlier.append(identifier)
            coming = "" if is_known else coming or identifier
        return earlier, coming

    def _known(self, identifiers: Iterator[str]) -> Iterator[tuple[str, bool]]:
        """Whether jobs have records, to the end of the first lot of which none has."""
        known = {""}
        while known:
            lot = list(islice(identifiers, JOBS_AT_ONCE))
            known = self.jobs.known(lot)
            yield from ((identifier, identifier in known) for identifier in lot)

    def _has_ended(self, identifier: str) -> bool:
        """Whether a job has ended, or is about to: its last step removes the drawing."""
        status = self._status(identifier)
        is_over = status is None or status.state.is_final
        return is_over or not self.blobs.exists(f"{INBOX}/{identifier}/{OBJECT}")

    def _release(self, drawing: str, earlier: Sequence[str]) -> None:
        """What was sent again is in quarantine no more, nor in the backlog on account of jobs that failed."""
        for identifier in earlier:
            self.blobs.delete(f"{INBOX}/{identifier}/")
        if self.blobs.exists(f"{QUARANTINE}/{drawing}/{OBJECT}"):
            self.blobs.delete(f"{QUARANTINE}/{drawing}/")

    def _is_in_a_job(self, identifier: str) -> bool:
        return self._status(identifier) is not None

    def _status(self, identifier: str) -> JobStatus | None:
        try:
            return self.jobs.status(identifier)
        except UnknownJob:
            return None

    def _quarantine(self, data: bytes, sender: str, source: str, error: InputError) -> Receipt:
        quarantine(self.blobs, hashlib.sha256(data).hexdigest(), data, str(error), {"sender": sender})
        entry = AuditEntry(AuditEvent.RECEIVED, source, self.title, outcome=Outcome.MINOR_FAILURE, note=str(error))
        self.audit.write(entry)
        self.log.warning("object quarantined", reason=str(error))
        return Receipt(Disposition.QUARANTINED)


def quarantine(blobs: BlobStore, name: str, data: bytes, reason: str, argument: Record) -> None:
    """Put an object aside with the reason.

    Args:
        argument: of its job, as far as it got one: who sent it, and the segments or regions that it is about.
    """
    labels = argument.get("labels")
    about = {"sender": argument.get("sender", ""), **({} if labels is None else {"segments": labels})}
    blobs.put(f"{QUARANTINE}/{name}/{OBJECT}", data)
    blobs.put(f"{QUARANTINE}/{name}/{REASON}", json.dumps({"reason": reason, **about}).encode())


def drawing_digests(found: Dataset, match: Match) -> list[str]:
    """One for each structure: the same for the same drawing, whichever way it comes and however often."""
    with tolerant("object"):
        content = found.to_json(bulk_data_threshold=1 << 62, suppress_invalid_tags=True)
    whole = _digest(f"{match.rule.name}\n{content}")
    if len(match.structures) == 1:
        return [whole]
    return [_digest(f"{whole}\n{sorted(labels or ())}") for labels in match.structures]


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
