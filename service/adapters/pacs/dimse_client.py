"""An archive behind DIMSE (PS3.4): C-GET or C-MOVE for images, C-STORE for results, C-FIND, storage commitment."""

import ssl
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pydicom import Dataset
from pynetdicom import AE, StoragePresentationContexts, build_role, evt

from service.adapters.dicom.objects import quiet
from service.adapters.pacs import sop_classes
from service.adapters.pacs.configuration import Archive, MoveDestination, Tls
from service.adapters.pacs.prompt_sockets import PROMPT
from service.adapters.pacs.tls import client_context, server_context
from service.errors import ArchiveRefused, ArchiveUnavailable
from service.pacs_ports import Retrieval

PENDING = (0xFF00, 0xFF01)
SUCCESS, SOME_FAILED, NOT_AUTHORISED = 0x0000, 0xB000, 0x0124
#: Answers to a request for commitment (PS3.7, C): it has been made already; it may succeed later.
DUPLICATE_TRANSACTION = 0x0131
PROCESSING_FAILURE, RESOURCE_LIMITATION = 0x0110, 0x0213


class DimseArchive:
    """The `PictureArchive` behind DIMSE."""

    def __init__(self, archive: Archive) -> None:
        self._archive = archive

    @property
    def commits(self) -> bool:
        """Whether the file asks for storage commitment."""
        return self._archive.commitment

    def echo(self) -> bool:
        """Whether the archive answers (C-ECHO)."""
        with self._associated([sop_classes.VERIFICATION]) as peer:
            return bool(peer.send_c_echo().get("Status", -1) == SUCCESS)

    def images(self, study: str, series: str) -> Retrieval:
        """Headers of a series; none when the archive does not have it."""
        query = Dataset()
        query.QueryRetrieveLevel, query.StudyInstanceUID, query.SeriesInstanceUID = "SERIES", study, series
        return self._get(query) if self._archive.move is None else self._move(query, self._archive.move)

    def store(self, objects: Sequence[Dataset]) -> None:
        """Send objects."""
        with self._associated(sorted({str(found.SOPClassUID) for found in objects})) as peer, quiet():
            for found in objects:
                status = peer.send_c_store(found).get("Status")
                if status is None:
                    raise ArchiveUnavailable("The archive ended the association.")
                if status & 0xFF00 == 0xA700:
                    raise ArchiveUnavailable("The archive has no room for the results now.")
                if status != SUCCESS and status & 0xF000 != 0xB000:
                    raise ArchiveRefused(f"The archive refused a result with status {status:04X}.")

    def lacking(self, objects: Sequence[Dataset]) -> list[Dataset]:
        """Those of the objects that a query does not find; all, when an archive that commits itself takes no query."""
        with self._associated([sop_classes.VERIFICATION, sop_classes.FIND]) as peer:
            accepted = {context.abstract_syntax for context in peer.accepted_contexts}
            if self.commits and sop_classes.FIND not in accepted:
                return list(objects)
            return [found for found in objects if not self._finds(peer, found)]

    def ask_commitment(self, objects: Sequence[Dataset], transaction: str) -> None:
        """N-ACTION; the archive reports later, to the listener."""
        request = Dataset()
        request.TransactionUID = transaction
        request.ReferencedSOPSequence = []
        for found in objects:
            item = Dataset()
            item.ReferencedSOPClassUID, item.ReferencedSOPInstanceUID = found.SOPClassUID, found.SOPInstanceUID
            request.ReferencedSOPSequence.append(item)
        with self._associated([sop_classes.COMMITMENT]) as peer:
            answer, _ = peer.send_n_action(request, 1, sop_classes.COMMITMENT, sop_classes.COMMITMENT_INSTANCE)
        status = answer.get("Status")
        if status in (None, PROCESSING_FAILURE, RESOURCE_LIMITATION):
            raise ArchiveUnavailable("The archive cannot take a request for storage commitment now.")
        if status not in (SUCCESS, DUPLICATE_TRANSACTION):
            raise ArchiveRefused("The archive refused to commit itself to the results.")

    def close(self) -> None:
        """Nothing is held open."""

    def _get(self, query: Dataset) -> Retrieval:
        found: dict[str, Dataset] = {}
        handlers = [(evt.EVT_C_STORE, _collect(found, query))]
        roles = [build_role(uid, scp_role=True) for uid in sop_classes.IMAGES]
        contexts = [sop_classes.FIND, sop_classes.GET, *sop_classes.IMAGES]
        failed = 0
        with self._associated(contexts, roles=roles, handlers=handlers) as peer:
            if self._matches(peer, query):  # archives fail to get what they do not have
                failed = _failures(peer.send_c_get(query, sop_classes.GET))
        return Retrieval(list(found.values()), failed)

    def _move(self, query: Dataset, target: MoveDestination) -> Retrieval:
        found: dict[str, Dataset] = {}
        failed = 0
        contexts = [sop_classes.FIND, sop_classes.MOVE]
        with self._receiving(target, _collect(found, query)), self._associated(contexts) as peer:
            if self._matches(peer, query):
                failed = _failures(peer.send_c_move(query, target.ae_title, sop_classes.MOVE))
        return Retrieval(list(found.values()), failed)

    @contextmanager
    def _receiving(self, target: MoveDestination, handler: Callable[[Any], int]) -> Iterator[None]:
        """The port that images are moved to is open for the archive, and for it alone."""
        entity: Any = AE(ae_title=target.ae_title)
        entity.require_called_aet = True
        entity.require_calling_aet = [self._archive.ae_title]
        for context in StoragePresentationContexts:
            entity.add_supported_context(context.abstract_syntax, list(sop_classes.PROPOSED_SYNTAXES))
        secure = None if self._archive.tls is None else _readable(server_context, self._archive.tls)
        handlers = [PROMPT, (evt.EVT_C_STORE, handler)]
        server = entity.start_server((target.host, target.port), block=False, ssl_context=secure, evt_handlers=handlers)
        try:
            yield
        finally:
            server.shutdown()

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

    @contextmanager
    def _associated(self, contexts: Sequence[str], **more: Any) -> Iterator[Any]:
        entity: Any = AE(ae_title=self._archive.local_ae_title)
        entity.acse_timeout = entity.dimse_timeout = entity.network_timeout = self._archive.timeout_s
        entity.connection_timeout = self._archive.timeout_s
        for context in contexts:
            entity.add_requested_context(context, list(sop_classes.PROPOSED_SYNTAXES))
        options = {"ext_neg": more.get("roles"), "evt_handlers": [PROMPT, *(more.get("handlers") or [])]}
        if self._archive.tls is not None:
            options["tls_args"] = (_readable(client_context, self._archive.tls), self._archive.host)
        peer = entity.associate(
            self._archive.host, self._archive.port, ae_title=self._archive.ae_title or "ANY-SCP", **options
        )
        if not peer.is_established:
            raise ArchiveUnavailable("The archive cannot be reached or does not accept the association.")
        try:
            yield peer
        except RuntimeError:  # what the library says of an association that has ended meanwhile
            raise ArchiveUnavailable("The archive ended the association.") from None
        except ValueError:  # and of a class that was not accepted in it
            raise ArchiveRefused("The archive does not accept a class of objects or a service.") from None
        finally:
            peer.release()


def _readable(context: Callable[[Tls], ssl.SSLContext], tls: Tls) -> ssl.SSLContext:
    """TLS with certificates from files that others may be renewing."""
    try:
        return context(tls)
    except OSError:
        raise ArchiveUnavailable("The certificates for the archive cannot be read.") from None


def _collect(found: dict[str, Dataset], query: Dataset) -> Callable[[Any], int]:
    """Keeps images of the series that was asked for, each once and without pixels."""
    wanted = (query.StudyInstanceUID, query.SeriesInstanceUID)

    def keep(event: Any) -> int:
        with quiet():
            image = event.dataset
            if (image.get("StudyInstanceUID"), image.get("SeriesInstanceUID")) != wanted:
                return NOT_AUTHORISED
            for tag in [tag for tag in image.keys() if tag.group == 0x7FE0]:  # noqa: SIM118 - not a mapping
                del image[tag]
            image.file_meta = event.file_meta
            found.setdefault(str(image.SOPInstanceUID), image)
        return SUCCESS

    return keep


def _failures(answers: Iterator[tuple[Dataset, Dataset | None]]) -> int:
    """Read the answers to the last: how many images the archive could not send.

    Raises:
        ArchiveUnavailable: it sent none, or ended the association.
    """
    last = Dataset()
    for status, _ in answers:
        last = status
    if last.get("Status") not in (SUCCESS, SOME_FAILED):
        raise ArchiveUnavailable("The archive did not send the images.")
    failed = int(last.get("NumberOfFailedSuboperations") or 0)
    return max(failed, 1) if last.Status == SOME_FAILED else failed
