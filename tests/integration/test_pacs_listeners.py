"""What comes over the network: associations, TLS, storage commitment and STOW, beside a real archive (Orthanc)."""

import gc
import io
import shutil
import socket
import ssl
import subprocess
import threading
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest
from pydicom import Dataset, dcmread
from pydicom.encaps import encapsulate
from pydicom.uid import JPEG2000Lossless, MRImageStorage
from pynetdicom import AE
from pynetdicom.association import Association
from pynetdicom.dul import DULServiceProvider

from benchmarks.pacs.orthanc import is_installed, send
from benchmarks.ports import free_ports
from service.adapters.dicom.results import RESULTS
from service.adapters.pacs import sop_classes
from service.adapters.pacs.commitment import Report, Requests
from service.adapters.pacs.configuration import Listener, MoveDestination, Tls
from service.adapters.pacs.dimse_client import DimseArchive
from service.adapters.pacs.inbox import INBOX, OBJECT
from service.adapters.pacs.moved_images import MOST_ASSOCIATIONS
from service.adapters.pacs.tls import client_context
from tests.dicom_parts import file_bytes, mr_series
from tests.pacs_archives import TITLE, FakeArchive
from tests.pacs_parts import (
    by_dicomweb,
    by_get,
    drawn_series,
    new_study,
    replace_archive,
    results_in,
    service_with,
)
from tests.service_parts import app_for, running
from tests.waiting import until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("sockets_of_refused_peers"),
    pytest.mark.skipif(not is_installed(), reason="Orthanc is not installed (Debian: orthanc orthanc-dicomweb dcmtk)"),
]


def associate(port: int, caller: str, called: str = "MORPHOFLOW", **more):
    entity = AE(ae_title=caller)
    entity.add_requested_context("1.2.840.10008.1.1")
    entity.add_requested_context("1.2.840.10008.5.1.4.1.1.66.4")
    return entity.associate("127.0.0.1", port, ae_title=called, **more)


def test_only_listed_callers_are_heard(orthanc, tmp_path):
    service = service_with(tmp_path, by_dicomweb(orthanc))
    (port,) = free_ports(1)
    with service.listening(Listener(port=port, calling_ae_titles=("VIEWER",))):
        peer = associate(port, "VIEWER")
        assert peer.is_established
        assert peer.send_c_echo().Status == 0
        peer.release()
        assert associate(port, "STRANGER").is_rejected
        assert associate(port, "VIEWER", "ANOTHER").is_rejected
    assert "STRANGER" in (tmp_path / "audit.jsonl").read_text()


def test_a_port_with_silent_connections_is_open(tmp_path):
    service = service_with(tmp_path, FakeArchive([]).settings())
    (port,) = free_ports(1)
    listener = Listener(port=port, calling_ae_titles=("VIEWER",), maximum_associations=1)
    with service.listening(listener), ExitStack() as silent:
        for _ in range(20):
            silent.enter_context(socket.create_connection(("127.0.0.1", port)))
        peer = associate(port, "VIEWER")
        assert peer.is_established
        peer.release()


def test_a_port_under_tls_waits_for_no_handshake(tmp_path, certificates):
    service = service_with(tmp_path, FakeArchive([]).settings())
    (port,) = free_ports(1)
    listener = Listener(port=port, calling_ae_titles=("VIEWER",), tls=certificates)
    with service.listening(listener), socket.create_connection(("127.0.0.1", port)):
        peer = associate(port, "VIEWER", tls_args=(client_context(certificates), "127.0.0.1"))
        assert peer.is_established
        peer.release()


def test_one_association_too_many_is_no_alert(tmp_path):
    service = service_with(tmp_path, FakeArchive([]).settings())
    (port,) = free_ports(1)
    listener = Listener(port=port, calling_ae_titles=("VIEWER",), maximum_associations=2)
    with service.listening(listener) as turned_away:
        peers = [associate(port, "VIEWER") for _ in range(3)]
        assert [peer.is_established for peer in peers] == [True, True, False]
        assert peers[2].is_rejected
        until(lambda: "association turned away" in service.said.getvalue())
        assert turned_away.count() == 1
        for peer in peers[:2]:
            peer.release()
    assert not (tmp_path / "audit.jsonl").exists()


def test_storescu_is_acknowledged_when_the_object_is_on_disk(orthanc, tmp_path):
    _, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, by_dicomweb(orthanc))
    (port,) = free_ports(1)
    path = tmp_path / "drawing.dcm"
    path.write_bytes(file_bytes(drawing))
    with service.listening(Listener(port=port, calling_ae_titles=("VIEWER",))):
        send([path], port, "MORPHOFLOW", "VIEWER")
    (key,) = [key for key in service.blobs.list(f"{INBOX}/") if key.endswith(OBJECT)]
    kept = dcmread(io.BytesIO(service.blobs.get(key)))
    assert kept.SOPInstanceUID == drawing.SOPInstanceUID
    assert kept.PixelData == drawing.PixelData


def test_storage_commitment_is_asked_for_and_reported(orthanc, ports, tmp_path):
    images, _ = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, by_dicomweb(orthanc))
    archive = DimseArchive(replace_archive(by_get(orthanc), commitment=True))
    unknown = mr_series()[:1]
    reports = {}
    with service.listening(Listener(port=ports.own, calling_ae_titles=("ORTHANC",))):
        for name, objects in {"held": images[:3], "unknown": unknown, "mixed": images[:2] + unknown}.items():
            requests = Requests(service.blobs, name)
            archive.ask_commitment(objects, requests.begin())
            until(requests.report)
            reports[name] = requests.report()
    lost = frozenset({str(unknown[0].SOPInstanceUID)})
    assert reports == {"held": Report(), "unknown": Report(lost), "mixed": Report(lost)}
    assert archive.lacking(images[:2] + unknown) == unknown


def test_results_go_to_an_archive_that_commits_itself(orthanc, ports, tmp_path):
    images, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, replace_archive(by_get(orthanc), commitment=True))
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with service.listening(Listener(port=ports.own, calling_ae_titles=("ORTHANC",))), service.working():
        service.until_empty()
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)
    assert list(service.blobs.list("dicom/commitments/")) == []


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
    with service.listening(Listener(port=port, calling_ae_titles=("MORPHOFLOW",), tls=certificates)):
        known = associate(port, "MORPHOFLOW", tls_args=(client_context(certificates), "127.0.0.1"))
        assert known.send_c_echo().Status == 0
        known.release()
        assert not associate(port, "MORPHOFLOW").is_established
        bare = ssl.create_default_context(cafile=str(certificates.authorities))
        stranger = associate(port, "MORPHOFLOW", tls_args=(bare, "127.0.0.1"))
        if stranger.is_established:
            stranger.send_c_echo()
        assert not stranger.is_established
    del stranger
    let_go()


def let_go() -> None:
    """Have the sockets of refused peers collected, once the library's threads that hold them have ended."""
    until(lambda: not any(isinstance(thread, Association | DULServiceProvider) for thread in threading.enumerate()))
    gc.collect()


def sent_to(port: int, caller: str, called: str, images, **more) -> list[int | None]:
    """Status of each image; none when the association was not accepted."""
    entity = AE(ae_title=caller)
    entity.add_requested_context(MRImageStorage)
    peer = entity.associate("127.0.0.1", port, ae_title=called, **more)
    statuses = [peer.send_c_store(image).get("Status") for image in images] if peer.is_established else []
    peer.release()
    return statuses


def test_moved_images_are_those_that_were_asked_for():
    images, others = mr_series(), mr_series(patient="OTHER")
    (port,) = free_ports(1)
    answers = []

    def meanwhile() -> None:
        answers.append(sent_to(port, "STRANGER", "MORPHOMOVE", others[:1]))
        answers.append(sent_to(port, TITLE, "ANOTHER", others[:1]))
        answers.append(sent_to(port, TITLE, "MORPHOMOVE", [others[0], images[0], images[0]]))

    archive = FakeArchive(images, destination=MoveDestination(ae_title="MORPHOMOVE", port=port))
    archive.before_moving = meanwhile
    with archive.running():
        found = DimseArchive(archive.settings()).images(images[0].StudyInstanceUID, images[0].SeriesInstanceUID)
    assert answers == [[], [], [0x0124, 0, 0]]
    assert sorted(image.SOPInstanceUID for image in found.images) == sorted(image.SOPInstanceUID for image in images)
    assert found.failed == 0


def test_silent_connections_keep_no_moved_images_away():
    images, (port,) = mr_series((12, 10, 4)), free_ports(1)
    archive = FakeArchive(images, destination=MoveDestination(ae_title="MORPHOMOVE", port=port))
    with ExitStack() as silent, archive.running():
        archive.before_moving = lambda: [
            silent.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(2 * MOST_ASSOCIATIONS)
        ]
        found = DimseArchive(archive.settings()).images(images[0].StudyInstanceUID, images[0].SeriesInstanceUID)
    assert {image.SOPInstanceUID for image in found.images} == {image.SOPInstanceUID for image in images}


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # the library's refused socket
def test_images_are_moved_over_tls_where_the_archive_has_it(certificates):
    images = mr_series()
    (port,) = free_ports(1)
    bare = []
    destination = MoveDestination(ae_title="MORPHOMOVE", port=port)
    archive = FakeArchive(images, destination=destination, tls=certificates)
    archive.before_moving = lambda: bare.append(sent_to(port, TITLE, "MORPHOMOVE", images[:1]))
    with archive.running():
        found = DimseArchive(archive.settings()).images(images[0].StudyInstanceUID, images[0].SeriesInstanceUID)
    assert bare == [[]]
    assert len(found.images) == len(images)
    let_go()


def compressed(image: Dataset) -> Dataset:
    """As an archive keeps it; the pixels are none."""
    found = dcmread(io.BytesIO(file_bytes(image)))
    found.file_meta.TransferSyntaxUID = JPEG2000Lossless
    found.PixelData = encapsulate([b"\0" * 10])
    found["PixelData"].is_undefined_length = True
    return found


def test_an_archive_may_forward_whatever_comes(tmp_path):
    images, drawing = drawn_series()
    service = service_with(tmp_path, FakeArchive([]).settings())
    (port,) = free_ports(1)
    files = [tmp_path / f"{number}.dcm" for number in range(2)]
    for file, found in zip(files, (images[0], drawing), strict=True):
        file.write_bytes(file_bytes(found))
    entity = AE("PACS")
    entity.add_requested_context(MRImageStorage, JPEG2000Lossless)
    for uid in sop_classes.SENT:
        entity.add_requested_context(uid)
    with service.listening(Listener(port=port, calling_ae_titles=("PACS",))):
        send(files, port, "MORPHOFLOW", "PACS")  # ends at the first object that is refused
        peer = entity.associate("127.0.0.1", port, ae_title="MORPHOFLOW")
        assert {context.abstract_syntax for context in peer.rejected_contexts} == set()
        assert peer.send_c_store(compressed(images[1])).Status == 0
        peer.release()
    assert service.inbox.backlog() == 1
    assert service.inbox.quarantined() == 0
    assert len(list(service.blobs.list("dicom/"))) == 2  # the drawing, and what its job is to do
    assert service.said.getvalue().count("left alone") == 2


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
        assert "morphoflow_dicom_turned_away 0.0" in client.get("/metrics").text
        torn = client.post(
            "/dicom-web/studies", content=b"--b\r\n", headers={"content-type": taken.request.headers["content-type"]}
        )
        assert torn.status_code == 415
        assert client.post("/dicom-web/studies", json={}).status_code == 415


def test_stow_keeps_nothing_of_what_is_no_drawing(tmp_path, pacs_file):
    images, _ = drawn_series()
    with running(app_for(tmp_path, pacs_file=pacs_file)) as client:
        answer = stow(client, file_bytes(compressed(images[0])))
        assert answer.status_code == 200
        assert answer.json()["00081199"]["Value"][0]["00081155"]["Value"] == [images[0].SOPInstanceUID]
        assert "morphoflow_dicom_quarantined 0.0" in client.get("/metrics").text


def test_stow_refuses_objects_of_another_study(tmp_path, pacs_file):
    images, drawing = drawn_series()
    _, other = drawn_series()
    path = f"/dicom-web/studies/{drawing.StudyInstanceUID}"
    with running(app_for(tmp_path, pacs_file=pacs_file)) as client:
        answer = stow(client, file_bytes(other), file_bytes(compressed(mr_series()[0])), path=path)
        assert answer.status_code == 409
        failed = answer.json()["00081198"]["Value"]
        assert [item["00081197"]["Value"] for item in failed] == [[0xA900], [0xA900]]
        assert failed[0]["00081155"]["Value"] == [other.SOPInstanceUID]
        assert "morphoflow_dicom_backlog 0.0" in client.get("/metrics").text
        assert "morphoflow_dicom_quarantined 0.0" in client.get("/metrics").text
        assert stow(client, file_bytes(drawing), file_bytes(other), path=path).status_code == 202
        assert stow(client, file_bytes(images[0]), path=path).status_code == 200
        until(lambda: "morphoflow_dicom_backlog 1.0" in client.get("/metrics").text)  # figures may be seconds old


def test_without_the_file_nothing_is_taken(tmp_path):
    with running(app_for(tmp_path)) as client:
        assert stow(client, b"").status_code == 404
