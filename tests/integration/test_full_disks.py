"""Disks without room: what was sent is refused with a problem, and taken again when there is room."""

import tempfile

import pytest

from tests.service_parts import app_for, mask_parts, problem, running
from tests.small_disks import fill, small_disk

RECONSTRUCTIONS, JOBS = "/v1/reconstructions", "/v1/jobs"
#: Longer than what the reader of forms keeps in memory.
LONG = bytes(3 << 20)
ASYNC = {"Prefer": "respond-async"}


@pytest.mark.parametrize(
    ("path", "parts"),
    [
        (RECONSTRUCTIONS, mask_parts(LONG)),
        ("/v1/planes", mask_parts(LONG)),
        (JOBS, [("kind", (None, "reconstructions")), ("archive", ("a.zip", LONG))]),
    ],
)
def test_a_body_that_finds_no_room_is_refused_and_taken_later(tmp_path, monkeypatch, path, parts):
    with small_disk(tmp_path / "temporary", "2m") as temporary, running(app_for(tmp_path)) as client:
        monkeypatch.setattr(tempfile, "tempdir", str(temporary))
        told = problem(client.post(path, files=parts), 507)
        assert told["type"].endswith("store-full")
        assert client.post(RECONSTRUCTIONS, files=mask_parts()).status_code == 201
        assert list(temporary.iterdir()) == []


def test_a_full_disk_is_told_to_those_who_ask_for_jobs(tmp_path):
    with small_disk(tmp_path / "disk", "2m") as disk, running(app_for(disk)) as client:
        ballast = fill(disk)
        forms = {"kind": (None, "samples"), "count": (None, "2")}
        for answer in (
            client.post(JOBS, files=forms),
            client.post(RECONSTRUCTIONS, files=mask_parts(), headers=ASYNC),
            client.post(RECONSTRUCTIONS, files=mask_parts()),
        ):
            assert answer.status_code in (503, 507), answer.text
        ballast.unlink()
        assert client.post(JOBS, files=forms).status_code == 202
