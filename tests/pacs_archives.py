"""An archive of a few lines over DIMSE, for what no real one does at one's bidding: to be late, to fail."""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from pydicom import Dataset
from pynetdicom import AE, AllStoragePresentationContexts, build_context, evt

from benchmarks.ports import free_ports
from service.adapters.pacs import sop_classes
from service.adapters.pacs.configuration import Archive, MoveDestination, Tls
from service.adapters.pacs.tls import client_context, server_context

TITLE = "ARCHIVE"


@dataclass
class FakeArchive:
    """Holds images and what it is sent; finds by UID, sends by C-GET and C-MOVE, keeps requests for commitment.

    Attributes:
        destination: where it moves images to.
        tls: of its port and of the associations that it asks for.
        before_moving: what happens when the port for moved images is open.
        withheld: how many of the images it fails to send.
        answers_queries: whether it takes C-FIND.
        stored: UIDs of results in the order in which they came, and the results.
        requests: Transaction UID and UIDs of the objects of each request.
    """

    images: Sequence[Dataset]
    withheld: int = 0
    answers_queries: bool = True
    destination: MoveDestination | None = None
    tls: Tls | None = None
    before_moving: Callable[[], object] = lambda: None
    port: int = field(default_factory=lambda: free_ports(1)[0])
    stored: list[str] = field(default_factory=list)
    results: list[Dataset] = field(default_factory=list)
    requests: list[tuple[str, list[str]]] = field(default_factory=list)
    asked: threading.Event = field(default_factory=threading.Event)

    def settings(self, **more: Any) -> Archive:
        more = {"move": self.destination, "tls": self.tls, **more}
        return Archive(name="archive", ae_title=TITLE, port=self.port, **more)

    @contextmanager
    def running(self) -> Iterator[None]:
        entity: Any = AE(TITLE)
        for context in AllStoragePresentationContexts:
            entity.add_supported_context(context.abstract_syntax, scu_role=True, scp_role=True)
        entity.requested_contexts = [build_context(uid) for uid in {image.SOPClassUID for image in self.images}]
        queries = [sop_classes.FIND] if self.answers_queries else []
        for uid in (sop_classes.VERIFICATION, sop_classes.GET, sop_classes.MOVE, *queries):
            entity.add_supported_context(uid)
        entity.add_supported_context(sop_classes.COMMITMENT)
        handlers: list[Any] = [
            (evt.EVT_C_FIND, self._find),
            (evt.EVT_C_GET, self._get),
            (evt.EVT_C_MOVE, self._move),
            (evt.EVT_C_STORE, self._store),
            (evt.EVT_N_ACTION, self._action),
        ]
        context = None if self.tls is None else server_context(self.tls)
        server = entity.start_server(("127.0.0.1", self.port), block=False, ssl_context=context, evt_handlers=handlers)
        try:
            yield
        finally:
            server.shutdown()

    def report(self, port: int, transaction: str, held: Sequence[str], failed: Sequence[str] = ()) -> int:
        """N-EVENT-REPORT to the listener of the service; the status that it answers."""
        information = Dataset()
        information.TransactionUID = transaction
        information.ReferencedSOPSequence = [_item(uid) for uid in held]
        if failed:
            information.FailedSOPSequence = [_item(uid) for uid in failed]
        entity: Any = AE(TITLE)
        entity.add_requested_context(sop_classes.COMMITMENT)
        peer = entity.associate("127.0.0.1", port, ae_title="MORPHOFLOW")
        assert peer.is_established
        kind = 2 if failed else 1
        status, _ = peer.send_n_event_report(information, kind, sop_classes.COMMITMENT, sop_classes.COMMITMENT_INSTANCE)
        peer.release()
        return int(status.Status)

    def _find(self, event: Any) -> Iterator[tuple[int, Dataset | None]]:
        wanted = event.identifier
        held = {image.SeriesInstanceUID for image in self.images} | {image.SOPInstanceUID for image in self.images}
        held.update(self.stored)
        if wanted.get("SOPInstanceUID", wanted.SeriesInstanceUID) in held:
            yield 0xFF00, wanted
        yield 0x0000, None

    def _get(self, _: Any) -> Iterator[Any]:
        yield len(self.images)
        for number, image in enumerate(self.images):
            if number >= len(self.images) - self.withheld:
                image = _in_a_class_of_its_own(image)
            yield 0xFF00, image

    def _move(self, _: Any) -> Iterator[Any]:
        assert self.destination is not None
        self.before_moving()
        secure = {} if self.tls is None else {"tls_args": (client_context(self.tls), "127.0.0.1")}
        yield self.destination.host, self.destination.port, secure
        yield len(self.images)
        for image in self.images:
            yield 0xFF00, image

    def _store(self, event: Any) -> int:
        self.stored.append(str(event.request.AffectedSOPInstanceUID))
        self.results.append(event.dataset)
        return 0x0000

    def _action(self, event: Any) -> tuple[int, None]:
        wanted = event.action_information
        uids = [str(item.ReferencedSOPInstanceUID) for item in wanted.ReferencedSOPSequence]
        self.requests.append((str(wanted.TransactionUID), uids))
        self.asked.set()
        return 0x0000, None


def _item(uid: str) -> Dataset:
    item = Dataset()
    item.ReferencedSOPClassUID, item.ReferencedSOPInstanceUID = "1.2.840.10008.5.1.4.1.1.66.4", uid
    return item


def _in_a_class_of_its_own(image: Dataset) -> Dataset:
    """One that the service did not propose, so that sending it fails."""
    found = Dataset()
    found.update(image)
    found.file_meta = image.file_meta
    found.SOPClassUID = "1.2.840.10008.5.1.4.1.1.6.1"
    return found
