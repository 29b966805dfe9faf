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
    """What becomes of a received object; it has been acknowledged in every case but the last."""

    ACCEPTED = "accepted"
    LEFT_ALONE = "left alone"
    QUARANTINED = "quarantined"
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

    def receive(self, data: bytes, sender: str) -> Receipt:
        """Take one object; when it is accepted it is on disk and in a durable job by then.

        Args:
            data: the file.
            sender: calling AE title, or the name of the way it came.
        """
        ...


class PictureArchive(Protocol):
    """An archive of images.

    Every call may raise `ArchiveUnavailable` (try again later) or `ArchiveRefused` (do not).
    """

    def images(self, study: str, series: str) -> list[DicomObject]:
        """Headers of a series without pixels, in no order; none when the archive does not have it."""
        ...

    def store(self, objects: Sequence[DicomObject]) -> None:
        """Store objects of one study; those that are there stay as they are."""
        ...

    def holds(self, objects: Sequence[DicomObject]) -> bool:
        """Whether the archive says that every one of the objects is stored."""
        ...

    def close(self) -> None:
        """Let go of connections."""
        ...
