"""Picture archives, whichever way they are reached."""

from service.adapters.pacs.configuration import Archive
from service.adapters.pacs.dicomweb import DicomWebArchive
from service.adapters.pacs.dimse_client import DimseArchive
from service.pacs_ports import PictureArchive


def open_archive(archive: Archive) -> PictureArchive:
    """The archive; nothing is sent yet."""
    return DicomWebArchive(archive) if archive.dicomweb is not None else DimseArchive(archive)
