"""The DIMSE listener: C-ECHO, C-STORE of drawings and of what is left alone, reports of storage commitment.

An object is acknowledged when it is on disk and in a durable job, never before.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from pydicom import Dataset
from pynetdicom import evt
from pynetdicom.presentation import PresentationContext

from service.adapters.pacs import sop_classes
from service.adapters.pacs.audit import AuditEntry, AuditEvent, AuditTrail, Outcome
from service.adapters.pacs.commitment import Report, Reports
from service.adapters.pacs.configuration import Listener
from service.adapters.pacs.listening import ListeningEntity
from service.adapters.pacs.prompt_sockets import PROMPT
from service.adapters.pacs.tls import server_context
from service.adapters.quiet import quiet
from service.pacs_ports import Disposition, ObjectReceiver

#: Status of a C-STORE (PS3.4, GG.4-1).
SUCCESS, CANNOT_UNDERSTAND, OUT_OF_RESOURCES, PROCESSING_FAILURE = 0x0000, 0xC000, 0xA700, 0x0110
#: Source of a rejection that is about the calling or the called title (PS3.8, 9.3.4).
TITLES = 0x01


@contextmanager
def dimse_listener(listener: Listener, desk: "PeerDesk") -> Iterator[None]:
    """Accept associations while the context lasts; what they bring goes to the desk."""
    callers = listener.calling_ae_titles
    entity: Any = ListeningEntity(listener.ae_title, callers, listener.maximum_associations)
    entity.add_supported_context(sop_classes.VERIFICATION)
    for uid in sop_classes.RECEIVED:
        entity.add_supported_context(uid, list(sop_classes.ACCEPTED_SYNTAXES))
    for uid in sop_classes.LEFT_ALONE:
        entity.add_supported_context(uid, list(sop_classes.LEFT_ALONE_SYNTAXES))
    entity.add_supported_context(sop_classes.COMMITMENT, scu_role=True, scp_role=True)
    handlers: list[Any] = [
        PROMPT,
        (evt.EVT_C_ECHO, lambda event: SUCCESS),
        (evt.EVT_C_STORE, desk.store),
        (evt.EVT_N_EVENT_REPORT, desk.report),
        (evt.EVT_REJECTED, desk.rejected),
    ]
    context = None if listener.tls is None else server_context(listener.tls)
    server = entity.start_server(
        (listener.host, listener.port),
        block=False,
        ssl_context=context,
        evt_handlers=handlers,
        contexts=_Shared(entity.supported_contexts),
    )
    desk.log.info("DICOM listener started", tls=context is not None)
    try:
        yield
    finally:
        server.shutdown()
        desk.log.info("DICOM listener stopped")


class _Shared(list[PresentationContext]):
    """Contexts that associations read and do not change; to copy all of them takes 0.1 s for each association."""

    def __deepcopy__(self, _: dict[int, Any]) -> "_Shared":
        return self


@dataclass(frozen=True)
class PeerDesk:
    """What is done with what peers send.

    Attributes:
        title: of the listener, in the audit trail.
        receiver: takes objects.
        reports: of the storage commitments that archives were asked for.
        audit: where associations of those who are not on the list are written down.
        log: tells what happens, without identifiers.
        turned_away: called for each association that is one too many.
    """

    title: str
    receiver: ObjectReceiver
    reports: Reports
    audit: AuditTrail
    log: Any
    turned_away: Callable[[], object]

    def store(self, event: Any) -> int:
        """C-STORE: the status that the sender is told."""
        sender = event.assoc.requestor.ae_title.strip()
        try:
            receipt = self.receiver.receive(event.encoded_dataset(), sender)
        except OSError:
            self.log.error("object cannot be kept")
            return OUT_OF_RESOURCES
        except Exception as fault:  # noqa: BLE001 - the sender must learn that it was not kept, whatever happened
            self.log.error("object cannot be taken", fault=type(fault).__name__)
            return PROCESSING_FAILURE
        return CANNOT_UNDERSTAND if receipt.disposition is Disposition.QUARANTINED else SUCCESS

    def report(self, event: Any) -> tuple[int, None]:
        """N-EVENT-REPORT: what an archive says on the commitment that it was asked for."""
        with quiet():
            information: Dataset = event.event_information
            transaction = str(information.TransactionUID)
            items = information.get("FailedSOPSequence") or []
            failed = frozenset(str(item.ReferencedSOPInstanceUID) for item in items)
        report = Report(failed if failed or event.event_type == 1 else None)
        if not self.reports.take(transaction, report):
            self.log.warning("report of a storage commitment that nobody awaits")
        return SUCCESS, None

    def rejected(self, event: Any) -> None:
        """An association of somebody who is not on the list, which is an alert; or one too many, which is counted."""
        if event.assoc.acceptor.primitive.result_source != TITLES:
            self.turned_away()
            self.log.warning("association turned away", reason="as many associations as are accepted are open")
            return
        caller = event.assoc.requestor.ae_title.strip()
        note = "An association was rejected."
        self.audit.write(AuditEntry(AuditEvent.REFUSED, caller, self.title, outcome=Outcome.SERIOUS_FAILURE, note=note))
        self.log.warning("association rejected")
