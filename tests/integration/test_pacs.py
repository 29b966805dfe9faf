"""Drawings and results between a real archive (Orthanc) and the job, by every way that the service speaks."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from pydicom.uid import RLELossless

from benchmarks.pacs.orthanc import is_installed
from benchmarks.ports import free_ports
from service.adapters.dicom.results import RESULTS
from service.adapters.pacs.archives import open_archive
from service.adapters.pacs.audit import TrailCheck, check_trail
from service.adapters.pacs.configuration import Archive
from service.pacs_ports import Disposition
from tests.dicom_parts import PATIENT_ID, PATIENT_NAME, file_bytes, mr_series, reread, ring, rtstruct_of, seg_of
from tests.pacs_parts import (
    Looks,
    by_dicomweb,
    by_get,
    by_move,
    drawn_series,
    new_study,
    put_images,
    results_in,
    service_with,
)
from tests.service_parts import sparse_ellipsoid
from tests.waiting import until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.usefixtures("sockets_of_refused_peers"),
    pytest.mark.skipif(not is_installed(), reason="Orthanc is not installed (Debian: orthanc orthanc-dicomweb dcmtk)"),
]

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
    assert check_trail(tmp_path / "audit.jsonl") == TrailCheck(None)
    trail = (tmp_path / "audit.jsonl").read_text()
    assert all(name in trail for name in ("VIEWER", "archive", drawing.SOPInstanceUID))


def test_images_come_by_c_move(orthanc, ports, tmp_path):
    images, _ = new_study(orthanc, tmp_path)
    retrieval = open_archive(by_move(orthanc, ports.own)).images(
        images[0].StudyInstanceUID, images[0].SeriesInstanceUID
    )
    found = retrieval.images
    assert retrieval.failed == 0
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
        service.until_empty()
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)


def test_a_corrected_drawing_has_results_of_its_own(orthanc, tmp_path):
    images, drawing = new_study(orthanc, tmp_path)
    corrected = reread(drawing)
    shifted = np.roll(corrected.pixel_array.astype(bool), 2, axis=2)
    corrected.PixelData = np.packbits(shifted.ravel(), bitorder="little").tobytes()
    service = service_with(tmp_path, by_dicomweb(orthanc))
    with service.working():
        for sent in (drawing, corrected, corrected, drawing):
            service.inbox.receive(file_bytes(sent), "VIEWER")
            service.until_empty()
    results = results_in(orthanc, images[0].StudyInstanceUID)
    assert len(results) == 2 * len(RESULTS)
    surfaces = [found.SurfaceSequence[0].SurfacePointsSequence[0] for found in results if "SurfaceSequence" in found]
    left, right = sorted(np.frombuffer(points.PointCoordinatesData, "<f4")[::3].mean() for points in surfaces)
    assert right - left == pytest.approx(2 * float(images[0].PixelSpacing[1]), abs=0.2)


def test_the_same_drawing_in_another_form_gives_results_once(orthanc, tmp_path):
    images, _ = new_study(orthanc, tmp_path)
    drawing = seg_of(images, sparse_ellipsoid()[0].astype(np.uint8), "LABELMAP")
    renamed, packed = reread(drawing), reread(drawing)
    renamed.PatientName = "Renamed^At^Archive"
    packed.compress(RLELossless, generate_instance_uid=False)
    service = service_with(tmp_path, by_dicomweb(orthanc))
    with service.working():
        for sent in (drawing, renamed, packed):
            assert service.inbox.receive(file_bytes(sent), "VIEWER").disposition is Disposition.ACCEPTED
            service.until_empty()
    assert service.reasons() == []
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)


@pytest.mark.parametrize("way", WAYS)
def test_results_that_the_archive_lost_come_back_with_the_drawing(way, orthanc, tmp_path):
    images, drawing = new_study(orthanc, tmp_path)
    service = service_with(tmp_path, WAYS[way](orthanc))
    made = []
    with service.working():
        for _ in range(2):
            service.inbox.receive(file_bytes(drawing), "VIEWER")
            service.until_empty()
            made.append({found.SOPInstanceUID for found in results_in(orthanc, images[0].StudyInstanceUID)})
            for item in orthanc.instances(images[0].StudyInstanceUID):
                if item["SOPInstanceUID"] in made[0]:
                    orthanc.client.delete(f"/instances/{item['ID']}").raise_for_status()
    assert len(made[0]) == len(RESULTS)
    assert made[1] == made[0]


@pytest.mark.parametrize("changed", [{"seed": 1}, {"mirror": "auto"}])
def test_a_drawing_that_is_sent_again_is_worked_on_as_the_rule_is_by_then(changed, orthanc, tmp_path):
    images, drawing = new_study(orthanc, tmp_path)
    for settings in ({}, changed):
        service = service_with(tmp_path, by_dicomweb(orthanc), **settings)
        service.inbox.receive(file_bytes(drawing), "VIEWER")
        assert service.inbox.backlog() == 1
        with service.working():
            service.until_empty()
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == 2 * len(RESULTS)


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
        until(lambda: service.said.getvalue().count("archive awaited") >= 3)
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
    assert service.reasons() == ["26 of the 26 images that the drawing refers to are not in the archive."]


@pytest.mark.parametrize("way", WAYS)
def test_nothing_is_made_of_half_a_series(way, orthanc, tmp_path):
    images, drawing = drawn_series()
    put_images(orthanc, tmp_path, images[:18])
    service, looks = service_with(tmp_path, WAYS[way](orthanc)), Looks()
    service.open_archive = looks.open
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with service.working():
        until(lambda: looks.count >= 3)  # what the first ones gave has been dealt with
        assert service.inbox.backlog() == 1
        assert results_in(orthanc, images[0].StudyInstanceUID) == []
        put_images(orthanc, tmp_path, images[18:])
        service.until_empty()
    results = results_in(orthanc, images[0].StudyInstanceUID)
    assert len(results) == len(RESULTS)
    (frames,) = {int(found.NumberOfFrames) for found in results if found.Modality == "OT"}
    assert 18 < frames <= len(images)


def test_a_drawing_in_quarantine_is_released_when_it_is_sent_again(orthanc, tmp_path):
    images, drawing = drawn_series()
    put_images(orthanc, tmp_path, images[:5] + images[9:])
    service = service_with(tmp_path, by_dicomweb(orthanc))
    service.configuration = service.configuration.model_copy(update={"images_awaited_s": 0.3})
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with service.working():
        service.until_empty()
        service.inbox.receive(file_bytes(drawing), "VIEWER")  # still too early
        service.until_empty()
        assert service.reasons() == ["4 of the 26 images that the drawing refers to are not in the archive."]
        put_images(orthanc, tmp_path, images[5:9])
        assert service.inbox.receive(file_bytes(drawing), "VIEWER").disposition is Disposition.ACCEPTED
        assert service.inbox.quarantined() == 0
        service.until_empty()
        assert service.inbox.quarantined() == 0
        service.inbox.receive(file_bytes(drawing), "VIEWER")  # once more, after the results
        service.until_empty()
        assert service.inbox.quarantined() == 0
    assert len(results_in(orthanc, images[0].StudyInstanceUID)) == len(RESULTS)


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
from tests.pacs_parts import service_with
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
from tests.pacs_parts import service_with
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
