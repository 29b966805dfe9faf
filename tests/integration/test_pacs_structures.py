"""Drawings of several structures: each is reconstructed by itself, given back by itself, or put aside by itself."""

import json

import numpy as np
import pytest
from pydicom import Dataset

from service.adapters.dicom.results import RESULTS
from service.adapters.pacs.inbox import ARGUMENT, INBOX, OBJECT, QUARANTINE, REASON
from service.pacs_ports import Disposition
from tests.analytic_model import MEAN_AXES
from tests.analytic_shapes import Ellipsoid
from tests.dicom_parts import file_bytes, grid_of, mr_series, reread, seg_of
from tests.pacs_archives import FakeArchive
from tests.pacs_parts import service_with

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("sockets_of_refused_peers")]

#: Distance of the middle of each structure from the plane between them (mm).
APART_MM = 17.0


@pytest.fixture(scope="module")
def images() -> list[Dataset]:
    return mr_series((64, 22, 18), spacing=(1.2, 1.2, 1.2))


def pair_on(images) -> np.ndarray:
    """An ellipsoid on each side, on every third plane, each a segment."""
    grid = grid_of(images)
    middle = grid.to_world((np.array([grid.shape]) - 1) / 2)[0]
    sides = [np.add(middle, [shift, 0.0, 0.0]) for shift in (-APART_MM, APART_MM)]
    drawn = np.stack([Ellipsoid(MEAN_AXES, side).mask(grid) for side in sides], -1).astype(np.uint8)
    drawn[:, :, [place for place in range(grid.shape[2]) if place % 3 != 1]] = 0
    return drawn


def sides_of(results) -> list[tuple[float, float]]:
    """Distance of the points of each surface from the plane between the structures: the least and the most (mm)."""
    found = []
    for surface in (found for found in results if "SurfaceSequence" in found):
        data = surface.SurfaceSequence[0].SurfacePointsSequence[0].PointCoordinatesData
        across = np.frombuffer(data, "<f4").reshape(-1, 3)[:, 0]
        found.append((float(across.min()), float(across.max())))
    return sorted(found)


def test_left_and_right_in_one_drawing_are_two_reconstructions(images, tmp_path):
    drawing = seg_of(images, pair_on(images), labels=("left hippocampus", "right hippocampus"))
    archive = FakeArchive(images)
    service = service_with(tmp_path, archive.settings(), segment_codes=("SCT:5366008",))
    receipt = service.inbox.receive(file_bytes(drawing), "VIEWER")
    assert receipt.disposition is Disposition.ACCEPTED
    assert service.inbox.backlog() == 2
    with archive.running(), service.working():
        service.until_empty()
        service.inbox.receive(file_bytes(drawing), "VIEWER")  # once more
        assert service.inbox.backlog() == 2
        service.until_empty()
    assert len(set(archive.stored)) == len(archive.stored) == 2 * len(RESULTS)
    names = [found.SegmentSequence[0].SegmentLabel for found in archive.results if "SegmentSequence" in found]
    assert sorted(names) == ["left hippocampus"] * 2 + ["right hippocampus"] * 2
    numbers = ["#1" in found.SeriesDescription for found in archive.results]
    assert sum(numbers) == sum("#2" in found.SeriesDescription for found in archive.results) == len(RESULTS)
    grid = grid_of(images)
    between = -grid.to_world((np.array([grid.shape]) - 1) / 2)[0][0]  # LPS
    (left, most_left), (least_right, right) = sides_of(archive.results)
    assert most_left < between < least_right
    assert most_left - left == pytest.approx(2 * MEAN_AXES[0], abs=2.0)
    assert right - least_right == pytest.approx(2 * MEAN_AXES[0], abs=2.0)


def test_a_structure_that_cannot_be_used_keeps_back_no_other(images, tmp_path):
    pair = pair_on(images)
    framed = seg_of(images, pair, labels=("left", "right"), omit_empty_frames=False)
    blank = reread(framed)
    blank.SegmentSequence[1].SegmentLabel = "right"
    values = np.array(blank.pixel_array)
    frames = enumerate(blank.PerFrameFunctionalGroupsSequence)
    right = [n for n, frame in frames if frame.SegmentIdentificationSequence[0].ReferencedSegmentNumber == 2]
    drawn = [number for number in right if values[number].any()]
    values[[number for number in right if number != drawn[0]]] = 0
    blank.PixelData = np.packbits(values.ravel().astype(bool), bitorder="little").tobytes()
    archive = FakeArchive(images)
    service = service_with(tmp_path, archive.settings())
    with archive.running(), service.working():
        for _ in range(2):  # to send it again changes nothing, and stores nothing of the other twice
            service.inbox.receive(file_bytes(blank), "VIEWER")
            service.until_empty()
            assert len(archive.stored) == len(RESULTS)
            (kept,) = [key for key in service.blobs.list(f"{QUARANTINE}/") if key.endswith(OBJECT)]
            told = json.loads(service.blobs.get(kept.replace(OBJECT, REASON)))
            assert told["segments"] == [2]
            assert "one slice only" in told["reason"]
    assert service.blobs.get(kept) == file_bytes(blank)
    (name,) = service.inbox.in_quarantine()
    service.inbox.send_again(name)  # the other is not in quarantine
    (key,) = [key for key in service.blobs.list(f"{INBOX}/") if key.endswith(ARGUMENT)]
    assert json.loads(service.blobs.get(key))["labels"] == [2]


def test_an_empty_segment_is_no_structure(images, tmp_path):
    pair = pair_on(images)
    pair[..., 1] = 0
    drawing = seg_of(images, pair, "LABELMAP", labels=("left", "right"))
    archive = FakeArchive(images)
    service = service_with(tmp_path, archive.settings())
    with archive.running(), service.working():
        service.inbox.receive(file_bytes(drawing), "VIEWER")
        assert service.inbox.backlog() == 1
        service.until_empty()
    assert service.reasons() == []
    assert len(archive.stored) == len(RESULTS)
    assert not [found for found in archive.results if "#" in found.SeriesDescription]
