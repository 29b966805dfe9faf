"""An archive behind DIMSE (PS3.4): C-GET or C-MOVE for images, C-STORE for results, C-FIND, storage commitment."""

import ssl
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from pydicom import Dataset
from pynetdicom import AE, build_role, evt

from service.adapters.pacs import sop_classes
from service.adapters.pacs.configuration import Archive, MoveDestination, Tls
from service.adapters.pacs.moved_images import receiving
from service.adapters.pacs.prompt_sockets import PROMPT
from service.adapters.pacs.tls import client_context, server_context
from service.adapters.quiet import quiet
from service.errors import ArchiveRefused, ArchiveUnavailable
from service.pacs_ports import Retrieval

PENDING = (0xFF00, 0xFF01)
SUCCESS, SOME_FAILED, NOT_AUTHORISED, DUPLICATE_INSTANCE = 0x0000, 0xB000, 0x0124, 0x0111
UNKNOWN_DESTINATION = 0xA801
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

    def images(self, study: str, series: str) -> Retrieval:
        """Headers of a series; none when the archive does not have it."""
        query = Dataset()
        query.QueryRetrieveLevel, query.StudyInstanceUID, query.SeriesInstanceUID = "SERIES", study, series
        return self._get(query) if self._archive.move is None else self._move(query, self._archive.move)

    def store(self, objects: Sequence[Dataset]) -> None:
        """Send objects; those that are there already stay as they are."""
        with self._associated(sorted({str(found.SOPClassUID) for found in objects})) as peer, quiet():
            for found in objects:
                status = peer.send_c_store(found).get("Status")
                if status is None:
                    raise ArchiveUnavailable("The archive ended the association.")
                if status & 0xFF00 == 0xA700:
                    raise ArchiveUnavailable("The archive has no room for the results now.")
                if status not in (SUCCESS, DUPLICATE_INSTANCE) and status & 0xF000 != 0xB000:
                    raise ArchiveRefused(f"The archive refused a result with status {status:04X}.")

    def lacking(self, objects: Sequence[Dataset]) -> list[Dataset]:
        """Those of the objects that a query does not find; all, when an archive that commits itself takes no query."""
        return [found for found in objects if not self._holds(found)]

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
        ending = Dataset()
        handlers = [(evt.EVT_C_STORE, _collect(found, query))]
        classes = self._classes(query) or sop_classes.IMAGES
        roles = [build_role(uid, scp_role=True) for uid in classes]
        contexts, images = [sop_classes.FIND, sop_classes.GET], sop_classes.image_contexts(classes)
        with self._associated(contexts, images=images, roles=roles, handlers=handlers) as peer:
            if self._matches(peer, query):  # archives fail to get what they do not have
                ending = _last(peer.send_c_get(query, sop_classes.GET))
        return _retrieval(found, ending)

    def _classes(self, query: Dataset) -> list[str]:
        """SOP classes of the images of a series, as far as a query tells."""
        wanted = Dataset()
        wanted.QueryRetrieveLevel, wanted.SOPInstanceUID, wanted.SOPClassUID = "IMAGE", "", ""
        wanted.StudyInstanceUID, wanted.SeriesInstanceUID = query.StudyInstanceUID, query.SeriesInstanceUID
        with self._associated([sop_classes.FIND]) as peer, quiet():
            answers = [answer for _, answer in peer.send_c_find(wanted, sop_classes.FIND) if answer is not None]
        told = {str(answer.get("SOPClassUID") or "") for answer in answers}
        return sorted(told & sop_classes.STORAGE)

    def _move(self, query: Dataset, target: MoveDestination) -> Retrieval:
        found: dict[str, Dataset] = {}
        ending = Dataset()
        contexts = [sop_classes.FIND, sop_classes.MOVE]
        secure = None if self._archive.tls is None else _readable(server_context, self._archive.tls)
        port = receiving(target, self._archive.ae_title or "", _collect(found, query), secure)
        with port, self._associated(contexts) as peer:
            if self._matches(peer, query):
                ending = _last(peer.send_c_move(query, target.ae_title, sop_classes.MOVE))
        return _retrieval(found, ending)

    def _holds(self, found: Dataset) -> bool:
        """Asked for in an association of its own: between two queries the library's reader may take an answer away."""
        query = Dataset()
        query.QueryRetrieveLevel = "IMAGE"
        for name in ("StudyInstanceUID", "SeriesInstanceUID", "SOPInstanceUID"):
            setattr(query, name, found[name].value)
        with self._associated([sop_classes.VERIFICATION, sop_classes.FIND]) as peer:
            is_refused = sop_classes.FIND not in {context.abstract_syntax for context in peer.accepted_contexts}
            return not (self.commits and is_refused) and self._matches(peer, query)

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
        entity.requested_contexts = [*entity.requested_contexts, *more.get("images", ())]
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


def _last(answers: Iterator[tuple[Dataset, Dataset | None]]) -> Dataset:
    """Read the answers to the last.

    Raises:
        ArchiveUnavailable: the archive ended the association.
    """
    last = Dataset()
    for status, _ in answers:
        last = status
    if "Status" not in last:
        raise ArchiveUnavailable("The archive did not send the images.")
    return last


def _retrieval(found: dict[str, Dataset], ending: Dataset) -> Retrieval:
    """What came, and how the archive ended it; without a status it had nothing to send."""
    status = int(ending.get("Status", SUCCESS))
    failed = int(ending.get("NumberOfFailedSuboperations") or 0)
    if status == SUCCESS:
        return Retrieval(list(found.values()), failed)
    fault = "" if status == SOME_FAILED else f"The archive could not send the images: status {status:04X}."
    if status == UNKNOWN_DESTINATION:
        fault = "The archive does not know the title that images are to be moved to."
    return Retrieval(list(found.values()), max(failed, 1), fault)
