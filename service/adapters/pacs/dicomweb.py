"""An archive behind DICOMweb (PS3.18): QIDO-RS, WADO-RS, STOW-RS."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import requests
from dicomweb_client import DICOMwebClient
from pydicom import Dataset

from service.adapters.pacs.configuration import Archive
from service.adapters.quiet import quiet
from service.errors import ArchiveRefused, ArchiveUnavailable
from service.pacs_ports import Retrieval

JSON = "application/dicom+json"
#: Answers after which the same request may succeed later.
_PASSING = (408, 425, 429, 500, 502, 503, 504)
#: Answers to credentials that have expired or are not known yet; those in the file are read anew each time.
_UNAUTHORISED = (401, 403)
#: Failure reasons (PS3.18, I.2.2): there is an instance of that UID already, by PS3.7 and by Azure's DICOM service.
ALREADY_THERE = {0x0111, 0xB00E}
OUT_OF_RESOURCES, UNKNOWN_REASON = 0xA700, 0x0110


class DicomWebArchive:
    """The `PictureArchive` behind DICOMweb."""

    def __init__(self, archive: Archive) -> None:
        self._session = _Session(archive)
        self._client = DICOMwebClient(archive.dicomweb or "", session=self._session)
        self._client.set_http_retry_params(retry=False)

    @property
    def commits(self) -> bool:
        """Storage commitment is a service of DIMSE."""
        return False

    def images(self, study: str, series: str) -> Retrieval:
        """Headers of a series; none when the archive does not have it."""
        found = _or_nothing(partial(self._client.retrieve_series_metadata, study, series))
        with quiet():
            return Retrieval([Dataset.from_json(_without_bulk(item)) for item in found])

    def store(self, objects: Sequence[Dataset]) -> None:
        """Send objects of one study; those that are there already stay as they are."""
        with _faults(), quiet():
            reasons = _failures(partial(self._client.store_instances, objects, str(objects[0].StudyInstanceUID)))
        reasons -= ALREADY_THERE
        if any(reason & 0xFF00 == OUT_OF_RESOURCES for reason in reasons):
            raise ArchiveUnavailable("The archive has no room for the results now.")
        if reasons:
            raise ArchiveRefused(f"The archive refused a result with reason {max(reasons):04X}.")

    def lacking(self, objects: Sequence[Dataset]) -> list[Dataset]:
        """Those of the objects that a query does not find."""
        places = {(str(found.StudyInstanceUID), str(found.SeriesInstanceUID)) for found in objects}
        held = set[str]().union(*(self._instances(*place) for place in places))
        return [found for found in objects if str(found.SOPInstanceUID) not in held]

    def ask_commitment(self, objects: Sequence[Dataset], transaction: str) -> None:
        """Never asked for."""
        raise NotImplementedError

    def close(self) -> None:
        """Let go of the connections."""
        self._session.close()

    def _instances(self, study: str, series: str) -> set[str]:
        found = _or_nothing(partial(self._client.search_for_instances, study, series))
        return {str(item["00080018"]["Value"][0]) for item in found}


class _Session(requests.Session):
    """A session with a time limit on each request and the archive's credentials."""

    def __init__(self, archive: Archive) -> None:
        super().__init__()
        self.headers["Accept"] = f"{JSON}, */*;q=0.5"
        self._timeout_s = archive.timeout_s
        if archive.authorization_file is not None:
            self.headers["Authorization"] = _credentials(archive.authorization_file)
        if archive.authorities is not None:
            self.verify = str(archive.authorities)
        if archive.tls is not None:
            self.cert = (str(archive.tls.certificate), str(archive.tls.key))
            self.verify = str(archive.tls.authorities)

    def request(self, *arguments: Any, **options: Any) -> requests.Response:
        """As its parent, but never without a time limit."""
        return super().request(*arguments, **{"timeout": self._timeout_s, **options})


def _credentials(file: Path) -> str:
    """Content of a file that others may be renewing."""
    try:
        return file.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        raise ArchiveUnavailable("The file with the archive's credentials cannot be read.") from None


class _faults:  # noqa: N801 - reads as a statement
    """Failures of the network and the archive as errors of the project, without addresses."""

    def __enter__(self) -> None: ...

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if isinstance(error, requests.HTTPError) and error.response is not None:
            status = error.response.status_code
            if status in _UNAUTHORISED:
                raise ArchiveUnavailable("The archive does not accept the credentials.") from None
            if status not in _PASSING:
                raise ArchiveRefused(f"The archive refused a request with status {status}.") from None
            raise ArchiveUnavailable("The archive cannot answer now.") from None
        if isinstance(error, requests.RequestException | OSError):
            raise ArchiveUnavailable("The archive cannot be reached.") from None


def _failures(store: Callable[[], Dataset]) -> set[int]:
    """Reasons that an archive gives for objects that it did not store, with whatever status it lists them."""
    try:
        answer = store()
    except requests.HTTPError as error:
        answer = _listed(error.response)
        if not answer.get("FailedSOPSequence"):
            raise
    return {int(item.get("FailureReason", UNKNOWN_REASON)) for item in answer.get("FailedSOPSequence") or []}


def _listed(response: requests.Response | None) -> Dataset:
    """The store instances response module of an answer 409 (none was stored); empty where there is none to be read."""
    if response is None or response.status_code != 409:
        return Dataset()
    try:
        return Dataset.from_json(response.json())
    except (ValueError, TypeError, KeyError, AttributeError):
        return Dataset()


def _or_nothing(ask: Callable[[], list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """The answer; empty where the archive says that there is nothing (404)."""
    with _faults():
        try:
            return ask()
        except requests.HTTPError as error:
            if error.response is not None and error.response.status_code == 404:
                return []
            raise


def _without_bulk(item: Mapping[str, Any]) -> dict[str, Any]:
    """The header's elements alone: bulk data are addresses, and no address is followed."""
    kept = {}
    for tag, element in item.items():
        if "BulkDataURI" in element or tag.startswith("7FE0"):
            continue
        if element.get("vr") == "SQ":
            element = {**element, "Value": [_without_bulk(inner or {}) for inner in element.get("Value", [])]}
        kept[tag] = element
    return kept
