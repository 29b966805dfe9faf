"""What the kinds of jobs work with, and how the choices of a request become a record and back."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from model.inference.calipers import USUAL_EXTENTS, parse_extents
from model.inference.reconstruction import Options
from service.job_archives import ArchiveLimits
from service.job_files import JobFiles, remove_job
from service.job_ports import BlobStore
from service.observability import Log
from service.ports import Catalogue, MaskReader, MeshWriter, ResultStore, VolumeWriter
from service.request_schemas import parse_annotated, parse_labels


@dataclass(frozen=True)
class JobTools:
    """The wired parts of a worker.

    Attributes:
        max_voxels: of any grid that is made on the way.
        archive_limits: of the archive of one job.
    """

    registry: Catalogue
    store: ResultStore
    blobs: BlobStore
    read_mask: MaskReader
    write_mesh: MeshWriter
    write_volume: VolumeWriter
    log: Log
    max_voxels: int
    archive_limits: ArchiveLimits

    def files(self, job: str) -> JobFiles:
        """The files of a job."""
        return JobFiles(self.blobs, job)

    def forget(self, job: str) -> None:
        """Remove what a job has made."""
        remove_job(self.blobs, self.store, job)


def options_of(record: Mapping[str, Any]) -> Options:
    """The choices of a reconstruction request, from a job's argument."""
    annotated = parse_annotated(record["annotated"])
    choices = record["uncertainty"], record["mirror"], record["resolution_mm"], record["seed"]
    extents = parse_extents(record["extents"]) if "extents" in record else USUAL_EXTENTS
    return Options(annotated, *choices, record.get("fidelity"), extents)


def labels_of(record: Mapping[str, Any]) -> frozenset[int] | None:
    """The labels of a reconstruction request, from a job's argument."""
    return parse_labels(record["label"])
