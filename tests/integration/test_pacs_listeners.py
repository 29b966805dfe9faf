"""What comes over the network: associations, TLS, storage commitment and STOW, beside a real archive (Orthanc)."""

import gc
import io
import shutil
import ssl
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from pydicom import dcmread
from pynetdicom import AE

from benchmarks.pacs.orthanc import is_installed, send
from benchmarks.ports import free_ports
from service.adapters.pacs.configuration import Archive, Listener, Tls
from service.adapters.pacs.dimse_client import DimseArchive
from service.adapters.pacs.dimse_server import dimse_listener
from service.adapters.pacs.inbox import INBOX, OBJECT
from tests.dicom_parts import file_bytes, mr_series
from tests.pacs_parts import (
    Service,
    by_dicomweb,
    by_get,
    new_study,
    replace_archive,
    service_with,
)
from tests.service_parts import app_for, running

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("sockets_of_refused_peers"),
    pytest.mark.skipif(not is_installed(), reason="Orthanc is not installed (Debian: orthanc orthanc-dicomweb dcmtk)"),
]


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
