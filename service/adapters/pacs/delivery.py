"""Between archives and files: images that a drawing refers to come in, results go out."""

import hashlib
import io
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from pydicom import Dataset, dcmread

from service.adapters.dicom.masks import referenced_series
from service.adapters.dicom.objects import quiet, read_object
from service.adapters.pacs.audit import AuditEntry, AuditEvent, AuditTrail
from service.adapters.pacs.configuration import Archive, PacsConfiguration
from service.adapters.pacs.inbox import IMAGES, INBOX, OBJECT, quarantine
from service.job_ports import BlobStore
from service.pacs_ports import PictureArchive

RESULTS = "results"


@dataclass(frozen=True)
class Desk:
    """The files of accepted drawings and the archives.

    Attributes:
        open_archive: connects to one.
        title: of this program in the audit trail.
    """

    configuration: PacsConfiguration
    blobs: BlobStore
    audit: AuditTrail
    open_archive: Callable[[Archive], PictureArchive]
    title: str

    def drawing(self, identifier: str) -> Dataset:
        """The object that was received."""
        return read_object(io.BytesIO(self.blobs.get(f"{INBOX}/{identifier}/{OBJECT}")), "object")

    def fetch(self, identifier: str, rule: str) -> bool:
        """Put the headers of the images beside the drawing; False when the archive has none of them yet."""
        drawing, name = self.drawing(identifier), self.configuration.rule(rule).fetch_from
        study = str(drawing.StudyInstanceUID)
        with self._opened(name) as archive:
            images = archive.images(study, str(referenced_series(drawing)))
        if not images:
            return False
        with quiet():
            content = json.dumps([image.to_json_dict(suppress_invalid_tags=True) for image in images])
        self.blobs.put(f"{INBOX}/{identifier}/{IMAGES}", content.encode())
        self.audit.write(AuditEntry(AuditEvent.FETCHED, name, self.title, study, _uids(images)))
        return True

    def images(self, identifier: str) -> list[Dataset]:
        """The headers that were fetched."""
        with quiet():
            return [Dataset.from_json(item) for item in json.loads(self.blobs.get(f"{INBOX}/{identifier}/{IMAGES}"))]

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
            if not opened.holds(results):
                opened.store(results)
                if not opened.holds(results):
                    raise OSError("The archive does not show the results that it took.")
        study = str(results[0].StudyInstanceUID)
        self.audit.write(AuditEntry(AuditEvent.SENT, self.title, archive, study, _uids(results)))
        return [hashlib.sha256(str(found.SOPInstanceUID).encode()).hexdigest() for found in results]

    def forget(self, identifier: str) -> None:
        """Remove everything of a drawing whose results were given back."""
        self.blobs.delete(f"{INBOX}/{identifier}/")

    def set_aside(self, identifier: str, reason: str) -> None:
        """Put a drawing in quarantine."""
        key = f"{INBOX}/{identifier}/{OBJECT}"
        if self.blobs.exists(key):
            quarantine(self.blobs, identifier, self.blobs.get(key), reason)
        self.forget(identifier)

    @contextmanager
    def _opened(self, name: str) -> Iterator[PictureArchive]:
        archive = self.open_archive(self.configuration.archive(name))
        try:
            yield archive
        finally:
            archive.close()


def _uids(objects: Sequence[Dataset]) -> list[tuple[str, str]]:
    return [(str(found.SOPClassUID), str(found.SOPInstanceUID)) for found in objects]


def _bytes_of(found: Any) -> bytes:
    buffer = io.BytesIO()
    with quiet():
        found.save_as(buffer, enforce_file_format=True)
    return buffer.getvalue()
