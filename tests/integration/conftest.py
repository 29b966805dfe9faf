"""A real archive (Orthanc) for the modules that want one."""

import gc
import warnings
from collections.abc import Iterator

import pytest

from benchmarks.pacs.orthanc import Orthanc, running_orthanc
from benchmarks.ports import free_ports
from tests.pacs_parts import Ports


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
