"""What a job has made as the members of an archive: its files in order, and the manifest last."""

import json
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from model.inference.plausibility import counted
from service.job_files import JobFiles
from service.ports import SAMPLES_JOB

MANIFEST = "manifest.json"


def result_members(job: JobFiles, kind: str, count: int) -> Iterator[tuple[str, bytes]]:
    """Names and contents, one item in memory at a time."""
    entries = []
    for number in range(count):
        contents, entry = job.item(number)
        entries.append(entry)
        yield from contents.items()
    manifest = {**job.note("manifest"), **(counts_of(entries) if kind == SAMPLES_JOB else {}), kind: entries}
    yield MANIFEST, json.dumps(manifest, indent=1).encode()


def counts_of(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What a manifest says of all samples: rejected draws by reason, and shapes that are implausible all the same."""
    return {
        "rejected": counted(sample["rejected"] for sample in samples),
        "implausible": sum(sample["plausible"] is False for sample in samples),
    }


def write_zip(archive: zipfile.ZipFile, job: JobFiles, kind: str, count: int) -> None:
    """All of it into an open archive."""
    for name, data in result_members(job, kind, count):
        archive.writestr(name, data)
