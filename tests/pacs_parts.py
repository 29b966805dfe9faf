"""A receiver beside a real archive (Orthanc): its files, a worker on demand, studies and results."""

import io
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydicom import Dataset, dcmread

from benchmarks.pacs.orthanc import Orthanc, send
from service.adapters.blobs import FolderBlobs
from service.adapters.image_guard import ImageLimits
from service.adapters.jobs.client import DbosJobs
from service.adapters.jobs.worker import WorkerOptions, running_worker
from service.adapters.pacs.archives import open_archive
from service.adapters.pacs.audit import AuditTrail
from service.adapters.pacs.commitment import Reports
from service.adapters.pacs.configuration import Archive, Listener, MoveDestination, PacsConfiguration, Rule
from service.adapters.pacs.delivery import Desk
from service.adapters.pacs.dimse_server import PeerDesk, dimse_listener
from service.adapters.pacs.inbox import QUARANTINE, REASON, Inbox
from service.jobs.drawings import DrawingTools, drawing_kind
from service.model_registry import ModelRegistry
from service.observability import make_log
from service.pacs import Tally, silence_libraries
from service.pacs_ports import PictureArchive, Retrieval
from tests.analytic_model import ellipsoid_model
from tests.dicom_parts import file_bytes, mr_series, seg_of
from tests.service_parts import sparse_ellipsoid
from tests.waiting import until


@dataclass(frozen=True)
class Ports:
    http: int
    dicom: int
    own: int


@dataclass
class Service:
    """The receiver, its files, and a worker on demand."""

    folder: Path
    configuration: PacsConfiguration
    said: io.StringIO
    open_archive: Callable[[Archive], PictureArchive] = open_archive

    def __post_init__(self) -> None:
        silence_libraries()
        self.blobs = FolderBlobs(self.folder / "files")
        self.url = f"sqlite:///{self.folder / 'jobs.sqlite'}"
        self.jobs = DbosJobs(self.url)
        self.audit = AuditTrail(self.folder / "audit.jsonl")
        self.log = make_log("debug", self.said)
        self.inbox = Inbox(self.configuration.rules, self.blobs, self.jobs, self.audit, "MORPHOFLOW", self.log)

    @contextmanager
    def working(self) -> Iterator[None]:
        registry = ModelRegistry({"ellipsoid": ellipsoid_model("ellipsoid")})
        desk = Desk(self.configuration, self.blobs, self.audit, self.open_archive, "MORPHOFLOW")
        limits = ImageLimits(max_bytes=1 << 24, max_voxels=1 << 22)
        kind = drawing_kind(DrawingTools(desk, registry, limits, "0.1.0", self.log))
        with running_worker([kind], WorkerOptions(self.url, "a-0"), self.log):
            yield

    @contextmanager
    def listening(self, listener: Listener) -> Iterator[Tally]:
        """The listener; counts associations that are one too many."""
        turned_away, reports = Tally(), Reports(self.blobs)
        desk = PeerDesk(listener.ae_title, self.inbox, reports, self.audit, self.log, turned_away.add)
        with dimse_listener(listener, desk):
            yield turned_away

    def until_empty(self) -> None:
        until(lambda: not self.inbox.backlog())

    def reasons(self) -> list[str]:
        """Why objects are in quarantine."""
        keys = [key for key in self.blobs.list(f"{QUARANTINE}/") if key.endswith(REASON)]
        return [json.loads(self.blobs.get(key))["reason"] for key in keys]


class Looks:
    """Opens archives, and counts how often they were looked through for images."""

    def __init__(self) -> None:
        self.count = 0

    def open(self, archive: Archive) -> PictureArchive:
        return _WatchedArchive(open_archive(archive), self)


class _WatchedArchive:
    def __init__(self, archive: PictureArchive, looks: Looks) -> None:
        self._archive, self._looks = archive, looks

    def __getattr__(self, name: str) -> Any:
        return getattr(self._archive, name)

    def images(self, study: str, series: str) -> Retrieval:
        found = self._archive.images(study, series)
        self._looks.count += 1
        return found


def by_dicomweb(orthanc: Orthanc) -> Archive:
    return Archive(name="archive", dicomweb=orthanc.dicomweb)


def by_get(orthanc: Orthanc) -> Archive:
    return Archive(name="archive", ae_title="ORTHANC", port=orthanc.dicom_port)


def by_move(orthanc: Orthanc, own: int) -> Archive:
    return replace_archive(by_get(orthanc), move=MoveDestination(ae_title="MORPHOMOVE", port=own + 1))


def replace_archive(archive: Archive, **changes) -> Archive:
    return archive.model_copy(update=changes)


def service_with(folder: Path, archive: Archive, **changes) -> Service:
    rule = Rule(name="all", model="ellipsoid", fetch_from="archive", send_to=("archive",), **changes)
    configuration = PacsConfiguration(archives=(archive,), rules=(rule,), retry_first_s=0.1, retry_longest_s=0.5)
    return Service(folder, configuration, io.StringIO())


def new_study(orthanc: Orthanc, folder: Path) -> tuple[list[Dataset], Dataset]:
    """Images in the archive, and a drawing on them."""
    images, drawing = drawn_series()
    put_images(orthanc, folder, images)
    return images, drawing


def drawn_series() -> tuple[list[Dataset], Dataset]:
    """Images, and a drawing on them."""
    images = mr_series()
    drawn, _ = sparse_ellipsoid()
    return images, seg_of(images, drawn)


def put_images(orthanc: Orthanc, folder: Path, images: Sequence[Dataset]) -> None:
    """Images into the archive."""
    place = Path(tempfile.mkdtemp(dir=folder))
    for number, image in enumerate(images):
        (place / f"{number}.dcm").write_bytes(file_bytes(image))
    send(place, orthanc.dicom_port)


def results_in(orthanc: Orthanc, study: str) -> list[Dataset]:
    found = [dcmread(io.BytesIO(orthanc.file(item["ID"]))) for item in orthanc.instances(study)]
    return [item for item in found if item.get("Manufacturer") == "MorphoFlow"]
