"""Files that belong to no job are removed, but none of a job that is only being made."""

from service.adapters.blobs import FolderBlobs
from service.adapters.jobs.client import DbosJobs
from service.jobs.strays import LOOK_EVERY_S, Strays


def test_files_without_a_job_are_removed_at_the_second_look(sqlite_url, tmp_path):
    now, jobs, blobs = [0.0], DbosJobs(sqlite_url), FolderBlobs(tmp_path / "files")
    late, kept, astray = (jobs.new_id("samples") for _ in range(3))
    for job in (late, kept, astray):
        blobs.put(f"jobs/{job}/inputs/00000000", b"1")
    jobs.enqueue("samples", {}, kept)
    strays = Strays(jobs, blobs, clock=lambda: now[0])
    assert strays.sweep() == 0
    now[0] += LOOK_EVERY_S
    assert strays.sweep() == 0
    jobs.enqueue("samples", {}, late)
    now[0] += LOOK_EVERY_S / 2
    assert strays.sweep() == 0
    now[0] += LOOK_EVERY_S / 2
    assert strays.sweep() == 1
    assert set(blobs.folders("jobs/")) == {late, kept}
    jobs.close()
