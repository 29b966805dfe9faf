"""What only some modules want: a real archive (Orthanc), a real browser, and a service with the models that ship."""

import gc
import warnings
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from benchmarks.pacs.orthanc import Orthanc, running_orthanc
from benchmarks.ports import free_ports
from benchmarks.server import serving
from tests.pacs_parts import Ports
from tests.page_parts import patient_browser


@pytest.fixture(scope="module")
def sockets_of_refused_peers():
    """pynetdicom leaves the socket of a peer that was cut off to the garbage collector, which reports it anywhere."""
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


@pytest.fixture(scope="module")
def ports() -> Ports:
    http, dicom, own, _ = free_ports(4)
    return Ports(http, dicom, own)


@pytest.fixture(scope="module")
def orthanc(tmp_path_factory, ports) -> Iterator[Orthanc]:
    folder = tmp_path_factory.mktemp("orthanc")
    with running_orthanc(folder, (ports.http, ports.dicom), ports.own, ports.own + 1, "do end") as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with patient_browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def address(shipped_bundles, browser) -> Iterator[str]:  # noqa: ARG001 - no service where nobody can visit it
    with serving(()) as server:
        yield str(server.client.base_url)
