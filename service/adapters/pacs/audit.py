"""The audit trail: DICOM audit messages (PS3.15, A.5) as JSON lines, each with the hash of the line before it.

A line that is changed, removed or put in between breaks the chain from there on. Studies and instances are
named by their UIDs, as the standard's messages name them; patients are not: the archive knows whose study
it is.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import Enum
from pathlib import Path
from typing import Any, BinaryIO

#: What stands for the line before the first.
GENESIS = "0" * 64
PROGRAM = "MorphoFlow"
#: How every line begins.
BEGINNING = b'{"hash": "'


class AuditEvent(Enum):
    """Event identification code (DCM), its meaning, and the event action code of the messages that are written."""

    STARTED = ("110120", "Application Start", "E")
    STOPPED = ("110121", "Application Stop", "E")
    RECEIVED = ("110104", "DICOM Instances Transferred", "C")
    FETCHED = ("110103", "DICOM Instances Accessed", "R")
    SENT = ("110104", "DICOM Instances Transferred", "R")
    REFUSED = ("110113", "Security Alert", "E")


class Outcome(Enum):
    """Event outcome indicator."""

    SUCCESS = 0
    MINOR_FAILURE = 4
    SERIOUS_FAILURE = 8


@dataclass(frozen=True)
class AuditEntry:
    """One event.

    Attributes:
        source, destination: who sent and who received: AE titles or names of archives.
        study: Study Instance UID, empty without one.
        instances: SOP Class UID and SOP Instance UID of each object.
        note: a sentence without identifiers.
    """

    event: AuditEvent
    source: str
    destination: str
    study: str = ""
    instances: Sequence[tuple[str, str]] = ()
    outcome: Outcome = Outcome.SUCCESS
    note: str = ""


class AuditTrail:
    """The trail in one file, written by all processes of a machine in turn."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def write(self, entry: AuditEntry) -> None:
        """Append one message; on disk when this returns."""
        self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
        with os.fdopen(handle, "r+b") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            line = chained(message(entry, datetime.now(UTC)), _last_hash(file))
            file.write(b"\n" + line if _is_torn(file) else line)
            file.flush()
            os.fsync(file.fileno())


@dataclass(frozen=True)
class TrailCheck:
    """What is found in a trail, by the numbers of its lines from 1.

    Attributes:
        broken: the first line that does not follow from the whole ones before it; None in an intact trail.
        torn: lines up to there that are only begun, as a killed process leaves them; those after them follow from the
            last whole line.
    """

    broken: int | None
    torn: tuple[int, ...] = ()


def check_trail(path: Path) -> TrailCheck:
    """Follow the chain of hashes."""
    previous, torn = GENESIS, list[int]()
    with path.open("rb") as file:
        for number, line in enumerate(file, 1):
            found = _hash_of(line)
            if found is None and _is_begun(line):
                torn.append(number)
            elif found is None or not _follows(line, previous):
                return TrailCheck(number, tuple(torn))
            else:
                previous = found
    return TrailCheck(None, tuple(torn))


def _is_begun(line: bytes) -> bool:
    """Whether the beginning of a line is all there is of it."""
    content = line.removesuffix(b"\n")
    return content[: len(BEGINNING)] == BEGINNING[: len(content)]


def _follows(line: bytes, previous: str) -> bool:
    """Whether a line is what is written of its message after the line of a hash."""
    try:
        return chained(json.loads(line)["message"], previous) == line.removesuffix(b"\n") + b"\n"
    except (ValueError, KeyError, TypeError):
        return False


def chained(content: dict[str, Any], previous: str) -> bytes:
    """A line: the message, the hash before it, and the hash over both."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    digest = hashlib.sha256(f"{previous}\n{text}".encode()).hexdigest()
    line = json.dumps({"previous": previous, "hash": digest, "message": content}, sort_keys=True, ensure_ascii=False)
    return f"{line}\n".encode()


def message(entry: AuditEntry, now: datetime) -> dict[str, Any]:
    """The audit message with the names of PS3.15, A.5.1."""
    code, meaning, action = entry.event.value
    by_class: dict[str, list[str]] = {}
    for kind, instance in entry.instances:
        by_class.setdefault(kind, []).append(instance)
    study = {
        "ParticipantObjectTypeCode": 2,
        "ParticipantObjectTypeCodeRole": 3,
        "ParticipantObjectIDTypeCode": {"csd-code": "110180", "codeSystemName": "DCM", "originalText": "Study UID"},
        "ParticipantObjectID": entry.study,
        "SOPClass": [{"UID": kind, "Instance": uids} for kind, uids in by_class.items()],
    }
    return {
        "EventIdentification": {
            "EventID": {"csd-code": code, "codeSystemName": "DCM", "originalText": meaning},
            "EventActionCode": action,
            "EventDateTime": now.isoformat(timespec="milliseconds"),
            "EventOutcomeIndicator": entry.outcome.value,
            **({"EventOutcomeDescription": entry.note} if entry.note else {}),
        },
        "ActiveParticipant": [
            _participant(entry.source, "110153", "Source Role ID"),
            _participant(entry.destination, "110152", "Destination Role ID"),
        ],
        "AuditSourceIdentification": {"AuditSourceID": PROGRAM, "code": "4"},
        "ParticipantObjectIdentification": [study] if entry.study else [],
    }


def _participant(name: str, code: str, meaning: str) -> dict[str, Any]:
    role = {"csd-code": code, "codeSystemName": "DCM", "originalText": meaning}
    return {"UserID": name, "UserIsRequestor": code == "110153", "RoleIDCode": role}


def _is_torn(file: BinaryIO) -> bool:
    """Whether a killed process left a part of a line at the end, which stays there; the position is the end's then."""
    if file.seek(0, os.SEEK_END) == 0:
        return False
    file.seek(-1, os.SEEK_END)
    return file.read(1) != b"\n"


def _last_hash(file: BinaryIO) -> str:
    """Hash of the last whole line; of the first line's predecessor where there is none."""
    size, span = file.seek(0, os.SEEK_END), 1 << 16
    while True:
        file.seek(max(0, size - span))
        found = next(filter(None, map(_hash_of, reversed(file.read().splitlines()))), None)
        if found is not None or span >= size:
            return found or GENESIS
        span *= 2


def _hash_of(line: bytes) -> str | None:
    """The hash that a line says it has; None for a part of one."""
    try:
        return str(json.loads(line)["hash"])
    except (ValueError, KeyError, TypeError):
        return None
