"""What a job has made is read whole, or told to be gone or away."""

import json
import shutil
import subprocess
import zipfile

import pytest

from service.adapters.blobs import FolderBlobs
from service.errors import Overloaded, UnknownResult
from service.job_files import JobFiles
from service.job_results import MANIFEST, result_members, write_zip
from service.ports import RECONSTRUCTIONS_JOB

JOB = "11111111-1111-4111-8111-111111111111"


class AwayBlobs(FolderBlobs):
    """Storage that gives so many files, and then does not answer."""

    def __init__(self, folder, left):
        super().__init__(folder)
        self._left = left

    def get(self, key):
        if self._left == 0:
            raise OSError("The object storage does not answer.")
        self._left -= 1
        return super().get(key)


def made(folder):
    files = JobFiles(FolderBlobs(folder), JOB)
    for number in range(2):
        files.put_item(number, {f"{number}.stl": b"%d" % number}, {"mask": f"{number}.nii"})
    files.put_note("manifest", {"unit": "mm"})
    return files


def test_items_come_in_order_and_the_manifest_last(tmp_path):
    target, job = tmp_path / "all.zip", made(tmp_path)
    write_zip(target, job, RECONSTRUCTIONS_JOB, 2)
    with zipfile.ZipFile(target) as archive:
        assert archive.namelist() == ["0.stl", "1.stl", MANIFEST]
        manifest = json.loads(archive.read(MANIFEST))
    assert manifest == {"unit": "mm", RECONSTRUCTIONS_JOB: [{"mask": "0.nii"}, {"mask": "1.nii"}]}


@pytest.mark.parametrize("gone", ["items/00000001/0", "notes/00000000.json", "notes/manifest.json"])
def test_what_is_gone_is_an_unknown_result(tmp_path, gone):
    job = made(tmp_path)
    (tmp_path / "jobs" / JOB / gone).unlink()
    with pytest.raises(UnknownResult):
        list(result_members(job, RECONSTRUCTIONS_JOB, 2))


@pytest.mark.parametrize("left", range(5))
def test_what_the_storage_does_not_give_is_for_later(tmp_path, left):
    made(tmp_path)
    with pytest.raises(Overloaded):
        list(result_members(JobFiles(AwayBlobs(tmp_path, left), JOB), RECONSTRUCTIONS_JOB, 2))


@pytest.mark.parametrize("left", range(5))
def test_no_file_is_left_half_written(tmp_path, left):
    made(tmp_path)
    target = tmp_path / "all.zip"
    with pytest.raises(Overloaded):
        write_zip(target, JobFiles(AwayBlobs(tmp_path, left), JOB), RECONSTRUCTIONS_JOB, 2)
    assert not target.exists()


def test_a_file_that_cannot_be_opened_stays_as_it_is(tmp_path):
    target, job = tmp_path / "all.zip", made(tmp_path)
    shutil.copy(shutil.which("sleep"), target)
    with subprocess.Popen([target, "60"]) as running:  # nobody may write a program that runs
        before = target.read_bytes()
        with pytest.raises(OSError, match="busy"):
            write_zip(target, job, RECONSTRUCTIONS_JOB, 2)
        assert target.read_bytes() == before
        running.kill()
