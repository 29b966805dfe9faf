"""Associations between two ends that would otherwise wait for each other."""

import socket

import pytest
from pydicom import Dataset
from pynetdicom import AE, evt

from service.adapters.pacs.prompt_sockets import PROMPT

FIND = "1.2.840.10008.5.1.4.1.2.2.1"


@pytest.fixture
def peers():
    """Sockets of both ends of an association, and the association."""
    seen = []

    def answers(event):
        seen.append(event.assoc.dul.socket.socket)
        yield from ((0xFF00, event.identifier) for _ in range(3))

    entity = AE()
    entity.add_supported_context(FIND)
    server = entity.start_server(("127.0.0.1", 0), block=False, evt_handlers=[PROMPT, (evt.EVT_C_FIND, answers)])
    caller = AE()
    caller.add_requested_context(FIND)
    association = caller.associate("127.0.0.1", server.server_address[1], evt_handlers=[PROMPT])
    yield association, seen
    association.release()
    server.shutdown()


def asked(association):
    query = Dataset()
    query.QueryRetrieveLevel, query.PatientID = "STUDY", "1" * 40
    return list(association.send_c_find(query, FIND))


def test_messages_pass_and_both_ends_send_at_once(peers):
    association, seen = peers
    answers = asked(association)
    assert [status.Status for status, _ in answers] == [0xFF00] * 3 + [0]
    assert [found.PatientID for _, found in answers[:3]] == ["1" * 40] * 3
    for end in (association.dul.socket.socket, *seen):
        assert end.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY) == 1
