"""Between archives and files: images that a drawing refers to come in, results go out."""

import hashlib
import io
import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from pydicom import Dataset, dcmread

from model.errors import InvalidMask
from service.adapters.dicom.masks import referenced_series, referenced_studies
from service.adapters.dicom.objects import read_object
from service.adapters.pacs.audit import AuditEntry, AuditEvent, AuditTrail
from service.adapters.pacs.commitment import Report, Requests
from service.adapters.pacs.configuration import Archive, PacsConfiguration
from service.adapters.pacs.inbox import ARGUMENT, IMAGES, INBOX, OBJECT, quarantine
from service.adapters.pacs.references import referenced_images
from service.adapters.quiet import quiet
from service.errors import ArchiveUnavailable
from service.job_ports import BlobStore, Record
from service.pacs_ports import PictureArchive, Retrieval

#: Beside a drawing: its results, how far archives are that commit themselves to them, and when others took them.
RESULTS, DELIVERIES, TAKEN = "results", "deliveries", "taken"
#: Beside a drawing: the moment that all of its results say that they were made at.
MOMENT = "moment.json"
#: Wait for an archive to show what it took before it is sent again (s).
SHOWN_S = 600.0
#: Wait for a report that comes at once, and between two looks for it (s); later ones are for the turns to come.
PROMPT_REPORT_S, LOOK_S = 2.0, 0.1


@dataclass(frozen=True)
class Desk:
    """The files of accepted drawings and the archives.

    Attributes:
        open_archive: connects to one.
        title: of this program in the audit trail.
        now_s: seconds since 1970.
    """

    configuration: PacsConfiguration
    blobs: BlobStore
    audit: AuditTrail
    open_archive: Callable[[Archive], PictureArchive]
    title: str
    now_s: Callable[[], float] = time.time

    def drawing(self, identifier: str) -> Dataset:
        """The object that was received."""
        return read_object(io.BytesIO(self.blobs.get(f"{INBOX}/{identifier}/{OBJECT}")), "object")

    def fetch(self, identifier: str, rule: str, labels: frozenset[int] | None = None) -> str | None:
        """Put the headers of the images beside the drawing; or, while any is missing, a sentence that says so.

        Args:
            labels: segments or regions that the rule chose, which are drawn on these images; all when None.

        Raises:
            InvalidMask: no images are referred to, or those of another patient.
        """
        drawing, name = self.drawing(identifier), self.configuration.rule(rule).fetch_from
        series = str(referenced_series(drawing, labels))
        with self._opened(name) as archive:
            study, found = _retrieved(archive, referenced_studies(drawing, series), series)
        if study != drawing.StudyInstanceUID:
            _require_same_patient(drawing, found.images)
        gap = _gap(referenced_images(drawing, series), found)
        if gap is not None:
            return gap
        with quiet():
            content = json.dumps([image.to_json_dict(suppress_invalid_tags=True) for image in found.images])
        self.blobs.put(f"{INBOX}/{identifier}/{IMAGES}", content.encode())
        self.audit.write(AuditEntry(AuditEvent.FETCHED, name, self.title, study, _uids(found.images)))
        return None

    def images(self, identifier: str) -> list[Dataset]:
        """The headers that were fetched."""
        with quiet():
            return [Dataset.from_json(item) for item in json.loads(self.blobs.get(f"{INBOX}/{identifier}/{IMAGES}"))]

    def moment_s(self, identifier: str) -> float:
        """When the results of a drawing are made (seconds since 1970): the same for all, also after a restart."""
        key = f"{INBOX}/{identifier}/{MOMENT}"
        if not self.blobs.exists(key):
            self.blobs.put(key, json.dumps(self.now_s()).encode())
        return float(json.loads(self.blobs.get(key)))

    def put_results(self, identifier: str, results: dict[str, Dataset]) -> None:
        """Keep results until they are given back; those that are there stay as they are."""
        for number, (name, found) in enumerate(results.items()):
            key = f"{INBOX}/{identifier}/{RESULTS}/{number}-{name}.dcm"
            if not self.blobs.exists(key):
                self.blobs.put(key, _bytes_of(found))

    def deliver(self, identifier: str, archive: str) -> list[str]:
        """Give the results to an archive and make sure that it has them; digests of their UIDs."""
        keys = sorted(self.blobs.list(f"{INBOX}/{identifier}/{RESULTS}/"))
        with quiet():
            results = [dcmread(io.BytesIO(self.blobs.get(key))) for key in keys]
        with self._opened(archive) as opened:
            if opened.commits:
                self._commit(opened, results, self._requests(identifier, archive), archive)
            else:
                self._store(opened, results, f"{INBOX}/{identifier}/{TAKEN}/{_name_of(archive)}.json")
        study = str(results[0].StudyInstanceUID)
        self.audit.write(AuditEntry(AuditEvent.SENT, self.title, archive, study, _uids(results)))
        return [hashlib.sha256(str(found.SOPInstanceUID).encode()).hexdigest() for found in results]

    def forget(self, identifier: str) -> None:
        """Remove everything of a drawing whose results were given back."""
        for key in list(self.blobs.list(f"{INBOX}/{identifier}/{DELIVERIES}/")):
            Requests(self.blobs, key).forget()
        self.blobs.delete(f"{INBOX}/{identifier}/")

    def set_aside(self, identifier: str, name: str, reason: str) -> None:
        """Put a drawing in quarantine under a name."""
        key = f"{INBOX}/{identifier}/{OBJECT}"
        if self.blobs.exists(key):
            quarantine(self.blobs, name, self.blobs.get(key), reason, self._argument(identifier))
        self.forget(identifier)

    def _argument(self, identifier: str) -> Record:
        """What the job was told; nothing where a killed process was about to remove the folder."""
        try:
            return dict(json.loads(self.blobs.get(f"{INBOX}/{identifier}/{ARGUMENT}")))
        except FileNotFoundError:
            return {}

    def _store(self, opened: PictureArchive, results: Sequence[Dataset], taken: str) -> None:
        """Send what a query does not find, and make sure that it finds it then.

        Args:
            taken: the file that says when the archive took the results.

        Raises:
            ArchiveUnavailable: it does not show them yet.
        """
        lacking = opened.lacking(results)
        if lacking and not self._was_taken(taken):
            opened.store(lacking)
            self.blobs.put(taken, json.dumps(self.now_s()).encode())
            lacking = opened.lacking(lacking)
        if lacking:
            raise ArchiveUnavailable("The archive does not show the results that it took.")

    def _was_taken(self, key: str) -> bool:
        """Whether the archive took the results not long ago."""
        return self.blobs.exists(key) and self.now_s() - float(json.loads(self.blobs.get(key))) < SHOWN_S

    def _commit(self, opened: PictureArchive, results: Sequence[Dataset], requests: Requests, archive: str) -> None:
        """Have an archive commit itself; asked once for all, and again only when it fails or is silent for long.

        What it was sent is sent again when it reports that it lacks it, not while it is silent.

        Raises:
            ArchiveUnavailable: it has not reported yet.
        """
        patience_s = self.configuration.archive(archive).commitment_awaited_s
        report = requests.report()
        if requests.progress.is_committed or (report is not None and report.is_success):
            requests.end()
            return
        if report is not None or not requests.is_awaited(self.now_s(), patience_s):
            lost = _failed(results, report) if report is not None else []
            if not requests.progress.transactions:
                lost = opened.lacking(results)
            if lost:
                opened.store(lost)
            opened.ask_commitment(results, requests.begin())
            requests.sent(self.now_s())
            if _comes_at_once(requests):
                requests.end()
                return
        raise ArchiveUnavailable("The archive has not committed itself to the results yet.")

    def _requests(self, identifier: str, archive: str) -> Requests:
        return Requests(self.blobs, f"{INBOX}/{identifier}/{DELIVERIES}/{_name_of(archive)}.json")

    @contextmanager
    def _opened(self, name: str) -> Iterator[PictureArchive]:
        archive = self.open_archive(self.configuration.archive(name))
        try:
            yield archive
        finally:
            archive.close()


def _retrieved(archive: PictureArchive, studies: Sequence[str], series: str) -> tuple[str, Retrieval]:
    """The first study that the archive has images of the series in, and what came of them."""
    for study in studies:
        found = archive.images(study, series)
        if found.images or found.failed:
            break
    return study, found


def _require_same_patient(drawing: Dataset, images: Sequence[Dataset]) -> None:
    patients = {str(found.get("PatientID") or "") for found in (drawing, *images)} - {""}
    if len(patients) > 1:
        raise InvalidMask(
            "The drawing and the images that it refers to are of different patients; those of one are accepted.",
            part="object",
        )


def _gap(wanted: frozenset[str], found: Retrieval) -> str | None:
    """What is missing of the images; None when all have come."""
    missing = wanted - {str(image.SOPInstanceUID) for image in found.images}
    if found.fault:
        return found.fault
    if missing:
        return f"{len(missing)} of the {len(wanted)} images that the drawing refers to are not in the archive."
    if found.failed:
        return f"{found.failed} images of the series that the drawing refers to could not be sent by the archive."
    return None if found.images else "The images that the drawing refers to are not in the archive."


def _name_of(archive: str) -> str:
    """Of an archive's files."""
    return hashlib.sha256(archive.encode()).hexdigest()


def _failed(results: Sequence[Dataset], report: Report) -> list[Dataset]:
    return [found for found in results if report.failed is None or str(found.SOPInstanceUID) in report.failed]


def _comes_at_once(requests: Requests) -> bool:
    """Whether the archive reports its success while one waits."""
    end = time.monotonic() + PROMPT_REPORT_S
    while requests.report() is None and time.monotonic() < end:
        time.sleep(LOOK_S)
    report = requests.report()
    return report is not None and report.is_success


def _uids(objects: Sequence[Dataset]) -> list[tuple[str, str]]:
    return [(str(found.SOPClassUID), str(found.SOPInstanceUID)) for found in objects]


def _bytes_of(found: Any) -> bytes:
    buffer = io.BytesIO()
    with quiet():
        found.save_as(buffer, enforce_file_format=True)
    return buffer.getvalue()
