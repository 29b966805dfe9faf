"""Archives that show late what they took, that refuse it, or that take no queries."""

import io
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
from pydicom import Dataset

from benchmarks.ports import free_ports
from service.adapters.dicom.results import RESULTS
from service.adapters.pacs.configuration import Listener, PacsConfiguration, Rule
from service.adapters.pacs.inbox import INBOX
from service.pacs_ports import Disposition
from tests.dicom_parts import file_bytes
from tests.pacs_archives import TITLE, FakeArchive
from tests.pacs_parts import Service, drawn_series, service_with
from tests.waiting import until

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("sockets_of_refused_peers")]


@dataclass
class LateArchive(FakeArchive):
    """Shows nothing of what it took until it is told to; what it has already it does not take again."""

    shows: threading.Event = field(default_factory=threading.Event)
    offered: list[str] = field(default_factory=list)

    def _find(self, event: Any) -> Iterator[tuple[int, Dataset | None]]:
        if "SOPInstanceUID" in event.identifier and not self.shows.is_set():
            yield 0x0000, None
        else:
            yield from super()._find(event)

    def _store(self, event: Any) -> int:
        uid = str(event.request.AffectedSOPInstanceUID)
        self.offered.append(uid)
        return 0x0111 if uid in self.stored else super()._store(event)


def awaited(service: Service) -> int:
    return service.said.getvalue().count("does not show the results that it took")


def test_what_an_archive_took_is_awaited_and_not_sent_again(tmp_path):
    images, drawing = drawn_series()
    archive = LateArchive(images)
    service = service_with(tmp_path, archive.settings())
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with archive.running():
        with service.working():
            until(lambda: awaited(service) >= 2)
        with service.working():  # another process
            until(lambda: awaited(service) >= 4)
            assert service.inbox.backlog() == 1
            archive.shows.set()
            service.until_empty()
    assert archive.offered == archive.stored
    assert len(archive.stored) == len(RESULTS)
    assert service.reasons() == []


def test_what_is_there_already_counts_as_stored(tmp_path):
    images, drawing = drawn_series()
    archive = LateArchive(images)
    with archive.running():
        for folder in ("one", "other"):
            (tmp_path / folder).mkdir()
            service = service_with(tmp_path / folder, archive.settings())
            service.inbox.receive(file_bytes(drawing), "VIEWER")
            with service.working():
                until(lambda: awaited(service) >= 1)  # noqa: B023 - over before the next one begins
        archive.shows.set()
        with service.working():
            service.until_empty()
    assert len(archive.offered) == 2 * len(RESULTS)
    assert len(archive.stored) == len(RESULTS)
    assert service.reasons() == []


def test_a_drawing_that_is_sent_again_goes_to_the_archives_of_the_rule_by_then(tmp_path):
    images, drawing = drawn_series()
    source, target = FakeArchive(images), FakeArchive([])
    archives = (source.settings(), target.settings().model_copy(update={"name": "target"}))
    with source.running(), target.running():
        for send_to in (("archive",), ("archive", "target")):
            rule = Rule(name="all", model="ellipsoid", fetch_from="archive", send_to=send_to)
            service = Service(tmp_path, PacsConfiguration(archives=archives, rules=(rule,)), io.StringIO())
            service.inbox.receive(file_bytes(drawing), "VIEWER")
            with service.working():
                service.until_empty()
    assert source.stored == target.stored
    assert len(set(target.stored)) == len(target.stored) == len(RESULTS)


def test_a_drawing_that_is_waited_on_is_not_begun_again(tmp_path):
    images, drawing = drawn_series()
    archive = FakeArchive(images)
    service = service_with(tmp_path, archive.settings())
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    (first,) = service.blobs.folders(f"{INBOX}/")
    with service.working():
        with archive.running():
            service.until_empty()
        until(lambda: service.jobs.status(first).state.is_final)
        service.inbox.receive(file_bytes(drawing), "VIEWER")  # the archive is away
        (second,) = service.blobs.folders(f"{INBOX}/")
        assert second != first
        until(lambda: "archive awaited" in service.said.getvalue())
        service.jobs.forget(first)  # as when it has expired
        service.inbox.receive(file_bytes(drawing), "VIEWER")
        assert list(service.blobs.folders(f"{INBOX}/")) == [second]
        with archive.running():
            service.until_empty()
    assert len(archive.stored) == len(RESULTS)


@dataclass
class RefusingArchive(FakeArchive):
    """Takes one result and no more until it is told to."""

    takes_all: threading.Event = field(default_factory=threading.Event)

    def _store(self, event: Any) -> int:
        return super()._store(event) if self.takes_all.is_set() or not self.stored else 0xC000


def test_results_that_an_archive_refused_are_sent_again_on_demand(tmp_path):
    images, drawing = drawn_series()
    archive = RefusingArchive(images)
    service = service_with(tmp_path, archive.settings(), senders=("VIEWER",))
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    with archive.running(), service.working():
        service.until_empty()
        assert service.reasons() == ["The archive refused a result with status C000."]
        archive.takes_all.set()
        (name,) = service.inbox.in_quarantine()
        assert service.inbox.send_again(name) is Disposition.ACCEPTED
        assert service.inbox.quarantined() == 0
        service.until_empty()
    assert service.reasons() == []
    assert len(set(archive.stored)) == len(archive.stored) == len(RESULTS)


def test_a_silent_archive_without_queries_is_asked_again_and_sent_nothing_twice(tmp_path):
    images, drawing = drawn_series()
    source, target, (port,) = FakeArchive(images), FakeArchive([], answers_queries=False), free_ports(1)
    silent = target.settings(commitment=True, commitment_awaited_s=1.0).model_copy(update={"name": "target"})
    rule = Rule(name="all", model="ellipsoid", fetch_from="archive", send_to=("target",))
    archives = (source.settings(), silent)
    configuration = PacsConfiguration(archives=archives, rules=(rule,), retry_first_s=0.1, retry_longest_s=0.5)
    service = Service(tmp_path, configuration, io.StringIO())
    service.inbox.receive(file_bytes(drawing), "VIEWER")
    listener = Listener(port=port, calling_ae_titles=(TITLE,))
    with source.running(), target.running(), service.listening(listener), service.working():
        until(lambda: len(target.requests) == 3)
        transaction, asked = target.requests[-1]
        assert len(target.stored) == len(RESULTS)
        target.report(port, transaction, asked[1:], failed=asked[:1])
        until(lambda: len(target.requests) == 4)
        assert target.stored == [*asked, asked[0]]
        target.report(port, target.requests[-1][0], asked)
        service.until_empty()
