"""Picture archives and what comes from them, as small protocols."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

#: A DICOM data set; only adapters look into it.
DicomObject = Any
#: Job that makes results of one received drawing and gives them back.
DRAWING_JOB = "drawing"


class Disposition(StrEnum):
    """What becomes of a received object; the sender is told of a failure in all cases but the first two."""

    ACCEPTED = "accepted"
    LEFT_ALONE = "left alone"
    QUARANTINED = "quarantined"
    MISPLACED = "of another study"
    FAILED = "failed"


@dataclass(frozen=True)
class Receipt:
    """Answer to one received object.

    Attributes:
        sop_class, sop_instance: its UIDs, empty when they cannot be read.
    """

    disposition: Disposition
    sop_class: str = ""
    sop_instance: str = ""


class ObjectReceiver(Protocol):
    """Takes DICOM objects, whichever way they come."""

    def receive(self, data: bytes, sender: str, study: str | None = None) -> Receipt:
        """Take one object; when it is accepted it is on disk and in a durable job by then.

        Args:
            data: the file.
            sender: calling AE title, or the name of the way it came.
            study: the only study whose objects are taken; any when None.
        """
        ...


@dataclass(frozen=True)
class Retrieval:
    """What came of a series.

    Attributes:
        images: headers without pixels, each once, in no order.
        failed: how many more the archive has and could not send.
        fault: the archive's reason for that in a sentence, where it gave one.
    """

    images: Sequence[DicomObject]
    failed: int = 0
    fault: str = ""


class PictureArchive(Protocol):
    """An archive of images.

    Every call may raise `ArchiveUnavailable` (try again later) or `ArchiveRefused` (do not).
    """

    @property
    def commits(self) -> bool:
        """Whether it is asked to commit itself to what it stores."""
        ...

    def images(self, study: str, series: str) -> Retrieval:
        """Headers of a series; none when the archive does not have it."""
        ...

    def store(self, objects: Sequence[DicomObject]) -> None:
        """Store objects of one study; those that are there stay as they are."""
        ...

    def lacking(self, objects: Sequence[DicomObject]) -> list[DicomObject]:
        """Those of the objects that a query does not find."""
        ...

    def ask_commitment(self, objects: Sequence[DicomObject], transaction: str) -> None:
        """Ask the archive to commit itself to objects that it was sent; it reports later, to the listener.

        Args:
            transaction: UID that the report will name; to ask twice under the same one is to ask once.
        """
        ...

    def close(self) -> None:
        """Let go of connections."""
        ...
