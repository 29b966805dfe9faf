"""What is kept beside a drawing while its job goes on."""

from service.adapters.blobs import FolderBlobs
from service.adapters.pacs.archives import open_archive
from service.adapters.pacs.audit import AuditTrail
from service.adapters.pacs.configuration import PacsConfiguration
from service.adapters.pacs.delivery import Desk


def desk_at(folder, now_s: float) -> Desk:
    """Of a process that has the time that it is told."""
    audit = AuditTrail(folder / "audit.jsonl")
    return Desk(PacsConfiguration(), FolderBlobs(folder), audit, open_archive, "MORPHOFLOW", lambda: now_s)


def test_all_processes_that_work_on_a_drawing_say_one_moment(tmp_path):
    assert [desk_at(tmp_path, now_s).moment_s("drawing") for now_s in (100.25, 200.0)] == [100.25, 100.25]
    assert desk_at(tmp_path, 300.0).moment_s("another") == 300.0
    desk_at(tmp_path, 400.0).forget("drawing")
    assert desk_at(tmp_path, 500.0).moment_s("drawing") == 500.0
