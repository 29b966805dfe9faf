"""Clients that go away in the middle: their work stops at its next evaluation, and their places are free."""

import io
import socket
import threading
import time
import uuid
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial

import pytest

from service.routes import archives
from tests.analytic_model import EllipsoidDecoder, ellipsoid_model
from tests.service_parts import NAME, app_for, mask_bytes, mask_parts, problem, running

RECONSTRUCTIONS = "/v1/reconstructions"


@dataclass(frozen=True)
class StoppedDecoder(EllipsoidDecoder):
    """Stands still in its second evaluation after the gate was closed, and counts those that come after it."""

    gate: threading.Event = field(default_factory=threading.Event)
    entered: threading.Event = field(default_factory=threading.Event)
    later: list[str] = field(default_factory=list)

    def close(self):
        """From now on."""
        self.later.clear()
        self.entered.clear()
        self.gate.clear()

    def _stop(self, kind):
        if not self.gate.is_set():
            self.later.append(kind)
            if len(self.later) > 1:
                self.entered.set()
                assert self.gate.wait(60.0)
                self.later.clear()
        else:
            self.later.append(kind)

    def logits(self, latent, points):
        self._stop("logits")
        return super().logits(latent, points)

    def logits_and_jacobians(self, latent, points):
        self._stop("jacobians")
        return super().logits_and_jacobians(latent, points)

    def logits_and_gradients(self, latent, points):
        self._stop("gradients")
        return super().logits_and_gradients(latent, points)


@pytest.fixture
def decoder():
    return StoppedDecoder()


@pytest.fixture
def log():
    return io.StringIO()


@pytest.fixture
def client(tmp_path, decoder, log):
    model = replace(ellipsoid_model(NAME), decoder=decoder)
    with running(app_for(tmp_path, model, log=log, workers=1, max_waiting=0)) as client:
        decoder.gate.set()
        yield client
        decoder.gate.set()


def until(condition, within_s=30.0):
    end = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def left_in_the_middle(client, decoder, log, path):
    """Kinds of evaluations that are begun after the client has left and the service has noticed."""
    name = uuid.uuid4().hex
    decoder.close()
    with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: here\r\nX-Request-ID: {name}\r\n\r\n".encode())
        assert decoder.entered.wait(30.0)
    until(lambda: name in log.getvalue())
    decoder.gate.set()
    until(lambda: client.get("/readyz").status_code == 200)
    return list(decoder.later)


@pytest.mark.parametrize(
    "path",
    [
        "segmentation?spacing_mm=0.5",
        "occupancy?spacing_mm=0.5",
        "uncertainty?spacing_mm=0.5",
        "features",
        "next-plane",
        "posterior?count=3",
        "interpolation?with={id}&at=0.3",
        "interpolation?with={id}&steps=5",
    ],
)
def test_work_on_a_result_ends_with_its_client(client, decoder, log, path):
    made = client.post(RECONSTRUCTIONS, files=mask_parts()).json()
    place = f"{made['links']['self']}/{path.format(id=made['id'])}"
    assert left_in_the_middle(client, decoder, log, place) == []
    assert client.get(place).status_code == 200
    assert len(decoder.later) > 1


@pytest.mark.parametrize("path", ["samples/1", "samples?count=3", "modes", "modes/1", "shape?mode=1:1"])
def test_work_on_a_model_ends_with_its_client(client, decoder, log, path):
    place = f"/v1/models/{NAME}/{path}"
    assert left_in_the_middle(client, decoder, log, place) == []
    assert client.get(place).status_code == 200
    assert len(decoder.later) > 1


def test_fewer_triangles_wait_for_a_place_and_the_kept_surface_does_not(client, decoder):
    made = client.post(RECONSTRUCTIONS, files=mask_parts(mask_bytes())).json()
    decoder.close()
    with socket.create_connection((client.base_url.host, client.base_url.port)) as connection:
        connection.sendall(f"GET /v1/models/{NAME}/samples/1 HTTP/1.1\r\nHost: here\r\n\r\n".encode())
        assert decoder.entered.wait(30.0)
        assert client.get(made["links"]["mesh"]).status_code == 200
        refused = client.get(made["links"]["mesh"], params={"max_error_mm": 0.2})
        assert problem(refused, 503)["type"].endswith("overloaded")
        assert refused.headers["retry-after"]
        decoder.gate.set()
    until(lambda: client.get("/readyz").status_code == 200)
    assert client.get(made["links"]["mesh"], params={"max_error_mm": 0.2}).status_code == 200


def test_clients_that_do_not_read_hold_no_place(tmp_path, monkeypatch):
    monkeypatch.setattr(archives, "STALLED_S", 2.0)
    path = f"GET /v1/models/{NAME}/samples?count=60&format=obj HTTP/1.1\r\nHost: here\r\n\r\n"
    with running(app_for(tmp_path, workers=1, max_waiting=1, max_samples=60)) as client, ExitStack() as held:
        begun = []
        while len(begun) < 4:
            slow = held.enter_context(socket.socket())
            slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            slow.settimeout(20.0)
            slow.connect((client.base_url.host, client.base_url.port))
            slow.sendall(path.encode())
            if slow.recv(12, socket.MSG_PEEK) == b"HTTP/1.1 200":  # else others are still busy filling their buffers
                begun.append(slow)
        until(lambda: client.post(RECONSTRUCTIONS, files=mask_parts()).status_code == 201)
        time.sleep(3.0)
        for slow in begun:
            assert b"manifest.json" not in b"".join(iter(partial(slow.recv, 1 << 16), b""))
