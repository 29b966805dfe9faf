"""Drawings and results between a real archive (Orthanc) and the job, by every way that the service speaks."""

import gc
import io
import json
import os
import shutil
import ssl
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import httpx
import pytest
from pydicom import Dataset, dcmread
from pynetdicom import AE

from benchmarks.pacs.orthanc import Orthanc, is_installed, running_orthanc, send
from benchmarks.ports import free_ports
from service.adapters.blobs import FolderBlobs
from service.adapters.dicom.results import RESULTS
from service.adapters.image_guard import ImageLimits
from service.adapters.jobs.client import DbosJobs
from service.adapters.jobs.worker import WorkerOptions, running_worker
from service.adapters.pacs.archives import open_archive
from service.adapters.pacs.audit import AuditTrail, broken_line
from service.adapters.pacs.configuration import Archive, Listener, MoveDestination, PacsConfiguration, Rule, Tls
from service.adapters.pacs.delivery import Desk
from service.adapters.pacs.dimse_client import DimseArchive
from service.adapters.pacs.dimse_server import dimse_listener
from service.adapters.pacs.inbox import INBOX, OBJECT, QUARANTINE, Inbox
from service.jobs.drawings import DrawingTools, drawing_kind
from service.model_registry import ModelRegistry
from service.observability import make_log
from service.pacs import silence_libraries
from service.pacs_ports import Disposition
from tests.analytic_model import ellipsoid_model
from tests.dicom_parts import PATIENT_ID, PATIENT_NAME, file_bytes, mr_series, reread, ring, rtstruct_of, seg_of
from tests.service_parts import app_for, running, sparse_ellipsoid

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not is_installed(), reason="Orthanc is not installed (Debian: orthanc orthanc-dicomweb dcmtk)"),
]
PATIENCE_S = 60.0


@pytest.fixture(autouse=True, scope="module")
def sockets_of_refused_peers():
    """pynetdicom leaves the socket of a peer that was cut off to the garbage collector, which reports it anywhere."""
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


@dataclass(frozen=True)
class Ports:
    http: int
    dicom: int
    own: int


@pytest.fixture(scope="module")
def ports() -> Ports:
    http, dicom, own, _ = free_ports(4)
    return Ports(http, dicom, own)


@pytest.fixture(scope="module")
def orthanc(tmp_path_factory, ports) -> Iterator[Orthanc]:
    folder = tmp_path_factory.mktemp("orthanc")
    with running_orthanc(folder, (ports.http, ports.dicom), ports.own, ports.own + 1, "do end") as found:
        yield found


@dataclass
class Service:
    """The receiver, its files, and a worker on demand."""

    folder: Path
    configuration: PacsConfiguration
    said: io.StringIO

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
        desk = Desk(self.configuration, self.blobs, self.audit, partial(open_archive, blobs=self.blobs), "MORPHOFLOW")
        limits = ImageLimits(max_bytes=1 << 24, max_voxels=1 << 22)
        kind = drawing_kind(DrawingTools(desk, registry, limits, "0.1.0", self.log))
        with running_worker([kind], WorkerOptions(self.url, "a-0"), self.log):
            yield

    def until_empty(self) -> None:
        limit = time.monotonic() + PATIENCE_S
        while self.inbox.backlog() and time.monotonic() < limit:
            time.sleep(0.05)
        assert self.inbox.backlog() == 0


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
    images = mr_series()
    (folder / "images").mkdir(exist_ok=True)
    for number, image in enumerate(images):
        (folder / "images" / f"{number}.dcm").write_bytes(file_bytes(image))
    send(folder / "images", orthanc.dicom_port)
    drawn, _ = sparse_ellipsoid()
    return images, seg_of(images, drawn)


def results_in(orthanc: Orthanc, study: str) -> list[Dataset]:
    found = [dcmread(io.BytesIO(orthanc.file(item["ID"]))) for item in orthanc.instances(study)]
    return [item for item in found if item.get("Manufacturer") == "MorphoFlow"]


WAYS = {"DICOMweb": by_dicomweb, "C-GET": by_get}


@pytest.mark.parametrize("way", WAYS)
def test_a_drawing_becomes_results_in_its_study(way, orthanc, tmp_path):
    images, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, WAYS[way](orthanc))
    receipt = service.inbox.receive(file_bytes(drawing), "VIEWER")
    assert receipt.disposition is Disposition.ACCEPTED
    assert receipt.sop_instance == drawing.SOPInstanceUID
    with service.working():
        service.until_empty()
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)
    assert broken_line(tmp_path / "audit.jsonl") is None
    trail = (tmp_path / "audit.jsonl").read_text()
    assert all(name in trail for name in ("VIEWER", "archive", drawing.SOPInstanceUID))


def test_images_come_by_c_move(orthanc, ports, tmp_path):
    images, _ = new_study(orthanc, tmp_path)
    archive = open_archive(by_move(orthanc, ports.own), FolderBlobs(tmp_path / "files"))
    found = archive.images(images[0].StudyInstanceUID, images[0].SeriesInstanceUID)
    assert {image.SOPInstanceUID for image in found} == {image.SOPInstanceUID for image in images}
    assert all("PixelData" not in image for image in found)


def test_contours_become_results_too(orthanc, tmp_path):
    images, _ = new_study(orthanc, tmp_path)
    contours = [("CLOSED_PLANAR", ring(images, number, (7.0,))[0]) for number in (8, 12, 16)]
    service = service_with(tmp_path, by_dicomweb(orthanc), segment_labels=("hippo*",))
    service.inbox.receive(file_bytes(rtstruct_of(images, contours)), "VIEWER")
    with service.working():
        service.until_empty()
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)


def test_the_same_drawing_twice_gives_results_once(orthanc, tmp_path):
    images, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, by_dicomweb(orthanc))
    with service.working():
        service.inbox.receive(file_bytes(drawing), "VIEWER")
        service.inbox.receive(file_bytes(drawing), "OTHER")
        service.until_empty()
        service.inbox.receive(file_bytes(reread(drawing)), "VIEWER")
        assert service.inbox.backlog() == 0
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)


def test_another_installation_makes_the_same_objects(orthanc, tmp_path):
    images, drawing = new_study(orthanc, tmp_path)
    for number in range(2):
        (tmp_path / str(number)).mkdir()
        service = service_with(tmp_path / str(number), by_dicomweb(orthanc))
        service.inbox.receive(file_bytes(drawing), "VIEWER")
        with service.working():
            service.until_empty()
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)


def test_an_archive_that_is_away_is_awaited(orthanc, tmp_path):
    _, drawing = new_study(orthanc, tmp_path)
    (port,) = free_ports(1)
    service = service_with(tmp_path, Archive(name="archive", dicomweb=f"http://127.0.0.1:{port}/dicom-web"))
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with service.working():
        limit = time.monotonic() + PATIENCE_S
        while service.said.getvalue().count("archive awaited") < 3 and time.monotonic() < limit:
            time.sleep(0.05)
        assert service.inbox.backlog() == 1
        assert service.inbox.quarantined() == 0
        relay = Relay(port, orthanc.http_port)
        with relay.running():
            service.until_empty()
    assert len(results_in(orthanc, drawing.StudyInstanceUID)) == len(RESULTS)


class Relay:
    """The archive's address comes to life: a TCP relay (socat's work, in a process that can be ended)."""

    def __init__(self, port: int, target: int) -> None:
        self._program = RELAY.format(port=port, target=target)

    @contextmanager
    def running(self) -> Iterator[None]:
        with subprocess.Popen([sys.executable, "-c", self._program]) as process:
            try:
                yield
            finally:
                process.terminate()


RELAY = """
import asyncio
async def pump(source, sink):
    while data := await source.read(65536):
        sink.write(data)
        await sink.drain()
    sink.close()
async def join(reader, writer):
    inner, outer = await asyncio.open_connection("127.0.0.1", {target})
    await asyncio.gather(pump(reader, outer), pump(inner, writer))
async def main():
    async with await asyncio.start_server(join, "127.0.0.1", {port}) as server:
        await server.serve_forever()
asyncio.run(main())
"""


@pytest.mark.parametrize("way", WAYS)
def test_images_may_come_after_the_drawing_but_not_for_ever(way, orthanc, tmp_path):
    drawn, _ = sparse_ellipsoid()
    drawing = seg_of(mr_series(), drawn)
    service = service_with(tmp_path, WAYS[way](orthanc))
    service.configuration = service.configuration.model_copy(update={"images_awaited_s": 0.3})
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with service.working():
        service.until_empty()
    assert service.inbox.quarantined() == 1
    (reason,) = [key for key in service.blobs.list(f"{QUARANTINE}/") if key.endswith("reason.json")]
    assert "not in the archive" in json.loads(service.blobs.get(reason))["reason"]


def test_broken_objects_go_to_quarantine_with_the_reason(orthanc, tmp_path):
    images, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, by_dicomweb(orthanc))
    assert service.inbox.receive(b"\0" * 128 + b"DICM" + b"nonsense", "VIEWER").disposition is Disposition.QUARANTINED
    empty = reread(drawing)
    empty.PixelData = bytes(len(empty.PixelData))
    assert service.inbox.receive(file_bytes(empty), "VIEWER").disposition is Disposition.ACCEPTED
    with service.working():
        service.until_empty()
    assert service.inbox.quarantined() == 2
    assert results_in(orthanc, images[0].StudyInstanceUID) == []


def test_what_no_rule_takes_is_left_alone(orthanc, tmp_path):
    _, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, by_dicomweb(orthanc), senders=("SOMEBODY",))
    assert service.inbox.receive(file_bytes(drawing), "VIEWER").disposition is Disposition.LEFT_ALONE
    assert service.inbox.backlog() == 0
    assert "left alone" in service.said.getvalue()


def test_no_identifier_is_in_logs_or_names(orthanc, tmp_path):
    images, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, by_dicomweb(orthanc))
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    broken = reread(drawing)
    broken.PixelData = b""
    service.inbox.receive(file_bytes(broken), "VIEWER")
    with service.working():
        service.until_empty()
    secrets = (PATIENT_NAME, PATIENT_ID, "19610503", images[0].StudyInstanceUID, drawing.SOPInstanceUID, "ACC-77")
    names = "\n".join(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    records = (tmp_path / "jobs.sqlite").read_bytes() + (tmp_path / "jobs.sqlite-wal").read_bytes() * (
        tmp_path / "jobs.sqlite-wal"
    ).exists()
    for secret in secrets:
        assert secret not in service.said.getvalue()
        assert secret not in names
        assert secret.encode() not in records


KILLED = """
import os, signal, sys
from pathlib import Path
from benchmarks.pacs.orthanc import Orthanc
from service.adapters.pacs.configuration import Archive
from service.adapters.pacs.delivery import Desk
from service.adapters.blobs import FolderBlobs
from tests.integration.test_pacs import service_with
place, moment, address = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
name, _, when = moment.partition(" ")
def deadly(owner, name):
    work = getattr(owner, name)
    def killed(*arguments):
        if when == "before":
            os.kill(os.getpid(), signal.SIGKILL)
        answer = work(*arguments)
        os.kill(os.getpid(), signal.SIGKILL)
    setattr(owner, name, killed)
deadly(Desk, name)
service = service_with(place, Archive(name="archive", dicomweb=address))
with service.working():
    service.until_empty()
"""
MOMENTS = [f"{name} {when}" for name in ("fetch", "put_results", "deliver", "forget") for when in ("before", "after")]


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_at_any_step_the_work_goes_on(moment, orthanc, tmp_path, repository):
    images, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, by_dicomweb(orthanc))
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", KILLED, str(tmp_path), moment, orthanc.dicomweb]
    assert subprocess.run(command, env=environment, cwd=repository, check=False).returncode == -9
    with service.working():
        service.until_empty()
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)


RECEIVED = """
import os, signal, sys
from pathlib import Path
from service.adapters.pacs.configuration import Archive
from tests.integration.test_pacs import service_with
service = service_with(Path(sys.argv[1]), Archive(name="archive", dicomweb=sys.argv[3]))
service.inbox.receive(Path(sys.argv[2]).read_bytes(), "VIEWER")
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_was_acknowledged_is_there_after_a_kill(orthanc, tmp_path, repository):
    images, drawing = new_study(orthanc, tmp_path)
    (tmp_path / "drawing.dcm").write_bytes(file_bytes(drawing))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", RECEIVED, str(tmp_path), str(tmp_path / "drawing.dcm"), orthanc.dicomweb]
    assert subprocess.run(command, env=environment, cwd=repository, check=False).returncode == -9
    service = service_with(tmp_path, by_dicomweb(orthanc))
    assert service.inbox.backlog() == 1
    with service.working():
        service.until_empty()
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)


def test_what_was_written_down_before_a_kill_is_taken_up(orthanc, tmp_path):
    images, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, by_dicomweb(orthanc))
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    service.jobs.close()
    for file in tmp_path.glob("jobs.sqlite*"):
        file.unlink()  # as if the kill had come before the job was made
    again = service_with(tmp_path, by_dicomweb(orthanc))
    again.inbox.take_up()
    with again.working():
        again.until_empty()
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)


@contextmanager
def listening(service: Service, listener: Listener) -> Iterator[None]:
    with dimse_listener(listener, service.inbox, service.blobs, service.audit, service.log):
        yield


def associate(port: int, caller: str, called: str = "MORPHOFLOW", **more):
    entity = AE(ae_title=caller)
    entity.add_requested_context("1.2.840.10008.1.1")
    entity.add_requested_context("1.2.840.10008.5.1.4.1.1.66.4")
    return entity.associate("127.0.0.1", port, ae_title=called, **more)


def test_only_listed_callers_are_heard(orthanc, tmp_path):
    service = service_with(tmp_path, by_dicomweb(orthanc))
    (port,) = free_ports(1)
    with listening(service, Listener(port=port, calling_ae_titles=("VIEWER",))):
        peer = associate(port, "VIEWER")
        assert peer.is_established
        assert peer.send_c_echo().Status == 0
        peer.release()
        assert associate(port, "STRANGER").is_rejected
        assert associate(port, "VIEWER", "ANOTHER").is_rejected
    assert "STRANGER" in (tmp_path / "audit.jsonl").read_text()


def test_storescu_is_acknowledged_when_the_object_is_on_disk(orthanc, tmp_path):
    _, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, by_dicomweb(orthanc))
    (port,) = free_ports(1)
    path = tmp_path / "drawing.dcm"
    path.write_bytes(file_bytes(drawing))
    with listening(service, Listener(port=port, calling_ae_titles=("VIEWER",))):
        send([path], port, "MORPHOFLOW", "VIEWER")
    (key,) = [key for key in service.blobs.list(f"{INBOX}/") if key.endswith(OBJECT)]
    kept = dcmread(io.BytesIO(service.blobs.get(key)))
    assert kept.SOPInstanceUID == drawing.SOPInstanceUID
    assert kept.PixelData == drawing.PixelData


def test_storage_commitment_is_asked_for_and_reported(orthanc, ports, tmp_path):
    images, _ = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, by_dicomweb(orthanc))
    archive = DimseArchive(replace_archive(by_get(orthanc), commitment=True), service.blobs)
    with listening(service, Listener(port=ports.own, calling_ae_titles=("ORTHANC",))):
        assert archive.holds(images[:3])
        unknown = mr_series()[:1]
        assert not archive.holds(unknown)
    assert archive.echo()


@pytest.fixture
def certificates(tmp_path) -> Tls:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    tls = Tls(certificate=tmp_path / "own.pem", key=tmp_path / "own.key", authorities=tmp_path / "own.pem")
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost"]
    names = ["-addext", "subjectAltName=IP:127.0.0.1,DNS:localhost"]
    subprocess.run([*command, *names, "-keyout", tls.key, "-out", tls.certificate], check=True, capture_output=True)
    return tls


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # the library's refused socket
def test_associations_over_tls_need_a_certificate(orthanc, tmp_path, certificates):
    service = service_with(tmp_path, by_dicomweb(orthanc))
    (port,) = free_ports(1)
    with listening(service, Listener(port=port, calling_ae_titles=("MORPHOFLOW",), tls=certificates)):
        peer = Archive(name="peer", ae_title="MORPHOFLOW", port=port, tls=certificates)
        assert DimseArchive(peer, service.blobs).echo()
        assert not associate(port, "MORPHOFLOW").is_established
        bare = ssl.create_default_context(cafile=str(certificates.authorities))
        stranger = associate(port, "MORPHOFLOW", tls_args=(bare, "127.0.0.1"))
        if stranger.is_established:
            stranger.send_c_echo()
        assert not stranger.is_established
    del stranger
    time.sleep(1)  # the library's threads let go of the refused sockets
    gc.collect()


@pytest.fixture
def pacs_file(orthanc, tmp_path) -> Path:
    path = tmp_path / "pacs.toml"
    path.write_text(
        f'[[archives]]\nname = "archive"\ndicomweb = "{orthanc.dicomweb}"\n'
        '[[rules]]\nname = "all"\nmodel = "ellipsoid"\nfetch_from = "archive"\nsend_to = ["archive"]\n'
        'senders = ["STOW-RS"]\n'
    )
    return path


def stow(client: httpx.Client, *objects: bytes, path: str = "/dicom-web/studies") -> httpx.Response:
    parts = b"".join(b"--b\r\nContent-Type: application/dicom\r\n\r\n" + data + b"\r\n" for data in objects)
    kind = 'multipart/related; type="application/dicom"; boundary=b'
    return client.post(path, content=parts + b"--b--\r\n", headers={"content-type": kind})


def test_stow_answers_for_each_object(orthanc, tmp_path, pacs_file):
    images, drawing = new_study(orthanc, tmp_path)
    with running(app_for(tmp_path, pacs_file=pacs_file)) as client:
        taken = stow(client, file_bytes(drawing), file_bytes(images[0]))
        assert taken.status_code == 200
        assert taken.headers["content-type"] == "application/dicom+json"
        assert len(taken.json()["00081199"]["Value"]) == 2
        some = stow(client, file_bytes(drawing), b"nonsense", path=f"/dicom-web/studies/{drawing.StudyInstanceUID}")
        assert some.status_code == 202
        assert some.json()["00081198"]["Value"][0]["00081197"]["Value"] == [0xC000]
        assert stow(client, b"nonsense").status_code == 409
        assert "morphoflow_dicom_backlog 1.0" in client.get("/metrics").text
        assert "morphoflow_dicom_quarantined 1.0" in client.get("/metrics").text
        torn = client.post(
            "/dicom-web/studies", content=b"--b\r\n", headers={"content-type": taken.request.headers["content-type"]}
        )
        assert torn.status_code == 415
        assert client.post("/dicom-web/studies", json={}).status_code == 415


def test_without_the_file_nothing_is_taken(tmp_path):
    with running(app_for(tmp_path)) as client:
        assert stow(client, b"").status_code == 404
