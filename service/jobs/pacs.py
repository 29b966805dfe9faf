"""The job of drawings, wired from the settings of a worker."""

from pathlib import Path

from service.adapters.pacs.archives import open_archive
from service.adapters.pacs.configuration import load_configuration
from service.adapters.pacs.delivery import Desk
from service.job_ports import BlobStore, JobKind
from service.jobs.drawings import DrawingTools, drawing_kind
from service.observability import Log
from service.pacs import audit_trail, silence_libraries, title_of
from service.ports import Catalogue
from service.settings import Settings
from service.wiring import image_limits, program_version


def pacs_kinds(settings: Settings, file: Path, registry: Catalogue, blobs: BlobStore, log: Log) -> tuple[JobKind, ...]:
    """The kinds of jobs of a worker among archives.

    Raises:
        InvalidParameter: the file cannot be used.
    """
    silence_libraries()
    configuration = load_configuration(file)
    audit = audit_trail(configuration, settings)
    desk = Desk(configuration, blobs, audit, open_archive, title_of(configuration))
    return (drawing_kind(DrawingTools(desk, registry, image_limits(settings), program_version(), log)),)
