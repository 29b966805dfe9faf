"""What a job has made as the members of an archive: its files in order, and the manifest last."""

import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from model.inference.plausibility import counted
from service.errors import Overloaded, UnknownResult
from service.job_files import JobFiles
from service.ports import SAMPLES_JOB

MANIFEST = "manifest.json"
#: What is said of a job whose result was deleted or has expired before it.
RESULT_GONE = "The job's result has expired or been deleted."
#: What is said of a job of a drawing.
GIVEN_BACK = "The job's results were given back to archives; they are not kept here."


def result_members(job: JobFiles, kind: str, count: int) -> Iterator[tuple[str, bytes]]:
    """Names and contents, one item in memory at a time.

    Raises:
        UnknownResult: they are not there any more.
        Overloaded: the storage does not give them now.
    """
    entries = []
    for number in range(count):
        with _reading():
            contents, entry = job.item(number)
        entries.append(entry)
        yield from contents.items()
    with _reading():
        note = job.note("manifest")
    manifest = {**note, **(counts_of(entries) if kind == SAMPLES_JOB else {}), kind: entries}
    yield MANIFEST, json.dumps(manifest, indent=1).encode()


@contextmanager
def _reading() -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        raise UnknownResult(RESULT_GONE) from None
    except OSError as fault:
        raise Overloaded("What the job has made cannot be read now; ask for it again later.") from fault


def counts_of(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What a manifest says of all samples: rejected draws by reason, and shapes that are implausible all the same."""
    return {
        "rejected": counted(sample["rejected"] for sample in samples),
        "implausible": sum(sample["plausible"] is False for sample in samples),
    }


def write_zip(target: Path, job: JobFiles, kind: str, count: int) -> None:
    """All of it in a file; none is left half written, and one that cannot be opened stays as it is."""
    with target.open("wb") as file:
        try:
            with zipfile.ZipFile(file, "w") as archive:
                for name, data in result_members(job, kind, count):
                    archive.writestr(name, data)
        except BaseException:
            if target.is_file():
                target.unlink()
            raise
