"""Requests for storage commitment outlive every process, and none is made twice."""

import pytest

from service.adapters.blobs import FolderBlobs
from service.adapters.pacs.commitment import COMMITMENTS, REMEMBERED, Report, Reports, Requests

KEY = "dicom/inbox/drawing/deliveries/archive.json"


@pytest.fixture
def blobs(tmp_path):
    return FolderBlobs(tmp_path)


def asked(blobs, now_s: float = 100.0) -> tuple[Requests, str]:
    requests = Requests(blobs, KEY)
    transaction = requests.begin()
    requests.sent(now_s)
    return requests, transaction


def test_a_request_is_awaited_by_whoever_comes_next(blobs):
    _, transaction = asked(blobs)
    later = Requests(blobs, KEY)
    assert later.is_awaited(109.0, patience_s=10.0)
    assert not later.is_awaited(110.0, patience_s=10.0)
    assert later.report() is None
    assert Reports(blobs).take(transaction, Report())
    assert later.report() == Report()
    later.end()
    assert Requests(blobs, KEY).progress.is_committed
    assert list(blobs.list(f"{COMMITMENTS}/")) == []


def test_a_request_that_may_not_have_arrived_keeps_its_transaction(blobs):
    first = Requests(blobs, KEY)
    transaction = first.begin()
    again = Requests(blobs, KEY)
    assert not again.is_awaited(0.0, patience_s=10.0)
    assert again.begin() == transaction


def test_a_request_that_was_answered_before_it_was_known_to_be_sent_is_over(blobs):
    first = Requests(blobs, KEY).begin()
    Reports(blobs).take(first, Report(None))
    assert Requests(blobs, KEY).begin() != first


def test_failures_are_named_and_settled_by_the_next_request(blobs):
    _, first = asked(blobs)
    Reports(blobs).take(first, Report(frozenset({"1.2"})))
    assert Requests(blobs, KEY).report() == Report(frozenset({"1.2"}))
    _, second = asked(blobs)
    assert second != first
    assert Requests(blobs, KEY).progress.transactions == (second,)
    assert not Reports(blobs).take(first, Report())


def test_a_report_without_names_fails_everything(blobs):
    requests, transaction = asked(blobs)
    Reports(blobs).take(transaction, Report(None))
    report = requests.report()
    assert report == Report(None)
    assert not report.is_success


def test_an_earlier_request_may_still_succeed_but_not_fail(blobs):
    _, first = asked(blobs)
    requests, _ = asked(blobs)
    Reports(blobs).take(first, Report(None))
    assert requests.report() is None
    Reports(blobs).take(first, Report())
    assert requests.report() == Report()


def test_of_a_silent_archive_only_the_last_requests_are_remembered(blobs):
    transactions = [asked(blobs)[1] for _ in range(REMEMBERED + 3)]
    requests = Requests(blobs, KEY)
    assert requests.progress.transactions == tuple(transactions[-REMEMBERED:])
    assert not Reports(blobs).take(transactions[0], Report())
    requests.forget()
    assert list(blobs.list(f"{COMMITMENTS}/")) == []
