"""A running service among archives: its file, its process, its settings."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

from benchmarks.pacs.orthanc import TITLE, Orthanc
from benchmarks.server import wait_until_ready

STOP_LIMIT_S = 60.0
_PROGRAM = "import sys; from service.cli import main; sys.exit(main(sys.argv[1:]))"
_FILE = """
retry_first_s = 0.2
retry_longest_s = 2.0

[listener]
port = {dicom_port}
calling_ae_titles = ["{title}", "SCENE"]

[[archives]]
name = "archive"
{archive}

[[rules]]
name = "hippocampus"
model = "{model}"
segment_codes = ["SCT:5366008"]
fetch_from = "archive"
send_to = ["archive"]
"""


@dataclass(frozen=True)
class Place:
    """Where a service runs: its folder and ports, and the model that drawings go to."""

    folder: Path
    http_port: int
    dicom_port: int
    model: str = "hippocampus"
    models: str = ""
    workers: int = 1

    @property
    def file(self) -> Path:
        """The file that says how it stands among archives."""
        return self.folder / "pacs.toml"

    @property
    def log(self) -> Path:
        """What the service writes."""
        return self.folder / "service.log"

    def environment(self) -> dict[str, str]:
        """Settings of the service's processes."""
        return {
            **os.environ,
            "MORPHOFLOW_RESULTS_FOLDER": str(self.folder / "results"),
            "MORPHOFLOW_PACS_FILE": str(self.file),
            "MORPHOFLOW_PORT": str(self.http_port),
            "MORPHOFLOW_JOB_NICE": "0",
            "MORPHOFLOW_JOB_WORKERS": str(self.workers),
            "MORPHOFLOW_MODELS": self.models,
            "OMP_NUM_THREADS": "1",
        }


def by_dicomweb(orthanc: Orthanc) -> str:
    """The archive reached by DICOMweb."""
    return f'dicomweb = "{orthanc.dicomweb}"'


def by_dimse(orthanc: Orthanc, more: str = "") -> str:
    """The archive reached by DIMSE."""
    return f'ae_title = "{TITLE}"\nport = {orthanc.dicom_port}\n{more}'


def write_file(place: Place, archive: str) -> None:
    """Write the file that says how the service stands among archives."""
    place.folder.mkdir(parents=True, exist_ok=True)
    place.file.write_text(_FILE.format(dicom_port=place.dicom_port, title=TITLE, archive=archive, model=place.model))


def start(place: Place) -> subprocess.Popen[bytes]:
    """The service and its worker in processes of their own session."""
    with place.log.open("ab") as log:
        command = [sys.executable, "-c", _PROGRAM, "serve"]
        return subprocess.Popen(command, env=place.environment(), stderr=log, start_new_session=True)


def kill(process: subprocess.Popen[bytes]) -> None:
    """Kill -9, the workers too."""
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@contextmanager
def running_service(place: Place) -> Iterator[httpx.Client]:
    """The service while the context lasts."""
    process = start(place)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{place.http_port}", timeout=120.0) as client:
            wait_until_ready(client, process, place.log)
            yield client
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_LIMIT_S)
        except subprocess.TimeoutExpired:
            kill(process)
