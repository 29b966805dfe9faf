"""An archive behind DIMSE (PS3.4): C-GET or C-MOVE for images, C-STORE for results, C-FIND or storage commitment."""

import hashlib
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pydicom import Dataset
from pydicom.uid import generate_uid
from pynetdicom import AE, StoragePresentationContexts, build_role, evt

from service.adapters.dicom.objects import quiet
from service.adapters.pacs import sop_classes
from service.adapters.pacs.configuration import Archive
from service.adapters.pacs.prompt_sockets import PROMPT
from service.adapters.pacs.tls import client_context
from service.errors import ArchiveRefused, ArchiveUnavailable
from service.job_ports import BlobStore

#: Longest wait for the report of a storage commitment, and between two looks for it (s).
COMMITMENT_S, LOOK_S = 20.0, 0.1
PENDING = (0xFF00, 0xFF01)
SUCCESS = 0x0000


def commitment_key(transaction: str) -> str:
    """Where the listener leaves the report of a storage commitment."""
    return f"dicom/commitments/{hashlib.sha256(transaction.encode()).hexdigest()}/report"


class DimseArchive:
    """The `PictureArchive` behind DIMSE.

    Args:
        blobs: where the listener leaves reports of storage commitment.
    """

    def __init__(self, archive: Archive, blobs: BlobStore) -> None:
        self._archive = archive
        self._blobs = blobs

    def echo(self) -> bool:
        """Whether the archive answers (C-ECHO)."""
        with self._associated([sop_classes.VERIFICATION]) as peer:
            return bool(peer.send_c_echo().get("Status", -1) == SUCCESS)

    def images(self, study: str, series: str) -> list[Dataset]:
        """Headers of a series; none when the archive does not have it."""
        query = Dataset()
        query.QueryRetrieveLevel, query.StudyInstanceUID, query.SeriesInstanceUID = "SERIES", study, series
        return self._get(query) if self._archive.move is None else self._move(query)

    def store(self, objects: Sequence[Dataset]) -> None:
        """Send objects."""
        with self._associated(sorted({str(found.SOPClassUID) for found in objects})) as peer, quiet():
            for found in objects:
                status = peer.send_c_store(found).get("Status")
                if status is None:
                    raise ArchiveUnavailable("The archive ended the association.")
                if status != SUCCESS and status & 0xF000 != 0xB000:
                    raise ArchiveRefused(f"The archive refused a result with status {status:04X}.")

    def holds(self, objects: Sequence[Dataset]) -> bool:
        """Whether the archive is committed to every one of the objects, or a query finds it."""
        if self._archive.commitment:
            return self._is_committed(objects)
        with self._associated([sop_classes.FIND]) as peer:
            return all(self._finds(peer, found) for found in objects)

    def close(self) -> None:
        """Nothing is held open."""

    def _get(self, query: Dataset) -> list[Dataset]:
        found: list[Dataset] = []
        handlers = [(evt.EVT_C_STORE, _collect(found))]
        roles = [build_role(uid, scp_role=True) for uid in sop_classes.IMAGES]
        contexts = [sop_classes.FIND, sop_classes.GET, *sop_classes.IMAGES]
        with self._associated(contexts, roles=roles, handlers=handlers) as peer:
            if self._matches(peer, query):  # archives fail to get what they do not have
                _finish(peer.send_c_get(query, sop_classes.GET))
        return found

    def _move(self, query: Dataset) -> list[Dataset]:
        target = self._archive.move
        assert target is not None
        found: list[Dataset] = []
        entity: Any = AE(ae_title=target.ae_title)
        entity.supported_contexts = StoragePresentationContexts
        handlers = [PROMPT, (evt.EVT_C_STORE, _collect(found))]
        server = entity.start_server((target.host, target.port), block=False, evt_handlers=handlers)
        try:
            with self._associated([sop_classes.FIND, sop_classes.MOVE]) as peer:
                if self._matches(peer, query):
                    _finish(peer.send_c_move(query, target.ae_title, sop_classes.MOVE))
        finally:
            server.shutdown()
        return found

    def _finds(self, peer: Any, found: Dataset) -> bool:
        query = Dataset()
        query.QueryRetrieveLevel = "IMAGE"
        for name in ("StudyInstanceUID", "SeriesInstanceUID", "SOPInstanceUID"):
            setattr(query, name, found[name].value)
        return self._matches(peer, query)

    def _matches(self, peer: Any, query: Dataset) -> bool:
        answers = list(peer.send_c_find(query, sop_classes.FIND))  # to the last, or the next query meets the rest
        if not answers or answers[-1][0].get("Status") != SUCCESS:
            raise ArchiveUnavailable("The archive did not answer a query.")
        return any(status.get("Status") in PENDING for status, _ in answers)

    def _is_committed(self, objects: Sequence[Dataset]) -> bool:
        request = Dataset()
        request.TransactionUID = generate_uid()
        request.ReferencedSOPSequence = []
        for found in objects:
            item = Dataset()
            item.ReferencedSOPClassUID, item.ReferencedSOPInstanceUID = found.SOPClassUID, found.SOPInstanceUID
            request.ReferencedSOPSequence.append(item)
        key = commitment_key(request.TransactionUID)
        with self._associated([sop_classes.COMMITMENT]) as peer:
            status, _ = peer.send_n_action(request, 1, sop_classes.COMMITMENT, sop_classes.COMMITMENT_INSTANCE)
            if status.get("Status") != SUCCESS:
                raise ArchiveRefused("The archive refused to commit itself to the results.")
        return self._report(key) == b"committed"

    def _report(self, key: str) -> bytes:
        end = time.monotonic() + COMMITMENT_S
        while time.monotonic() < end:
            if self._blobs.exists(key):
                report = self._blobs.get(key)
                self._blobs.delete(f"{key.rpartition(chr(47))[0]}/")
                return report
            time.sleep(LOOK_S)
        raise ArchiveUnavailable("The archive has not reported on its storage commitment.")

    @contextmanager
    def _associated(self, contexts: Sequence[str], **more: Any) -> Iterator[Any]:
        entity: Any = AE(ae_title=self._archive.local_ae_title)
        entity.acse_timeout = entity.dimse_timeout = entity.network_timeout = self._archive.timeout_s
        entity.connection_timeout = self._archive.timeout_s
        for context in contexts:
            entity.add_requested_context(context, list(sop_classes.PROPOSED_SYNTAXES))
        options = {"ext_neg": more.get("roles"), "evt_handlers": [PROMPT, *(more.get("handlers") or [])]}
        if self._archive.tls is not None:
            options["tls_args"] = (client_context(self._archive.tls), self._archive.host)
        peer = entity.associate(
            self._archive.host, self._archive.port, ae_title=self._archive.ae_title or "ANY-SCP", **options
        )
        if not peer.is_established:
            raise ArchiveUnavailable("The archive cannot be reached or does not accept the association.")
        try:
            yield peer
        finally:
            peer.release()


def _collect(found: list[Dataset]) -> Callable[[Any], int]:
    def keep(event: Any) -> int:
        with quiet():
            image = event.dataset
            for tag in [tag for tag in image.keys() if tag.group == 0x7FE0]:  # noqa: SIM118 - not a mapping
                del image[tag]
            image.file_meta = event.file_meta
        found.append(image)
        return SUCCESS

    return keep


def _finish(answers: Iterator[tuple[Dataset, Dataset | None]]) -> None:
    """Read the answers to the last; `ArchiveUnavailable` when it is a failure."""
    last = None
    for status, _ in answers:
        last = status.get("Status")
    if last is None or (last != SUCCESS and last != 0xB000):
        raise ArchiveUnavailable("The archive did not send the images.")
