"""Orthanc with its DICOMweb plugin (Debian: orthanc, orthanc-dicomweb) on free ports of this machine."""

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

TITLE = "ORTHANC"
#: Where dcmtk is: pynetdicom brings a program called storescu too, with other options.
SYSTEM_PATH = "/usr/local/bin:/usr/bin:/bin"
#: Programs of dcmtk, and Orthanc, gather short segments unless this says otherwise; each then waits for 40 ms.
PROMPT = {"TCP_NODELAY": "1"}
PLUGIN = Path("/usr/share/orthanc/plugins/libOrthancDicomWeb.so")
START_LIMIT_S, STOP_LIMIT_S = 60.0, 30.0
#: Forwards drawings, but not results, to the service.
FORWARD = """
function OnStoredInstance(id, tags, metadata, origin)
  local drawing = tags['Modality'] == 'SEG' or tags['Modality'] == 'RTSTRUCT'
  if drawing and tags['Manufacturer'] ~= 'MorphoFlow' then
    %s
  end
end
"""
#: As a job of its own, which can be asked for and repeated; SendToModality gathers all in one.
BY_DIMSE = (
    """RestApiPost('/modalities/morphoflow/store', '{"Resources":["' .. id .. '"],"Asynchronous":true}', false)"""
)
BY_DICOMWEB = """RestApiPost('/dicom-web/servers/morphoflow/stow', '{"Resources":["' .. id .. '"]}', false)"""

#: Orthanc closes a connection that was idle for a second, maybe just when the next request goes out on it.
ONE_REQUEST_EACH = httpx.Limits(max_keepalive_connections=0)


@dataclass(frozen=True)
class Orthanc:
    """A running archive: its REST interface and its ports."""

    client: httpx.Client
    http_port: int
    dicom_port: int

    @property
    def dicomweb(self) -> str:
        """Base address of its DICOMweb services."""
        return f"http://127.0.0.1:{self.http_port}/dicom-web"

    def instances(self, study: str | None = None) -> list[dict[str, str]]:
        """Main tags of every instance, of one study if it is named."""
        wanted = {} if study is None else {"StudyInstanceUID": study}
        query: dict[str, Any] = {"Level": "Instance", "Expand": True, "Query": wanted}
        found = self.client.post("/tools/find", json=query).raise_for_status().json()
        return [{**item["MainDicomTags"], "ID": item["ID"], "ParentSeries": item["ParentSeries"]} for item in found]

    def count(self) -> int:
        """How many objects it holds."""
        return int(self.client.get("/statistics").raise_for_status().json()["CountInstances"])

    def forwards(self) -> dict[str, str]:
        """State of each object's forwarding, by its identifier."""
        found = self.client.get("/jobs", params={"expand": ""}).raise_for_status().json()
        return {job["ID"]: job["State"] for job in found if job["Type"] == "DicomModalityStore"}

    def forward_again(self, identifier: str) -> None:
        """Repeat a forwarding that failed."""
        self.client.post(f"/jobs/{identifier}/resubmit").raise_for_status()

    def series(self) -> list[dict[str, str]]:
        """Main tags of every series, with the number of its instances."""
        found = self.client.get("/series", params={"expand": ""}).raise_for_status().json()
        return [{**item["MainDicomTags"], "ID": item["ID"], "Instances": str(len(item["Instances"]))} for item in found]

    def file(self, identifier: str) -> bytes:
        """An instance as a DICOM file."""
        return self.client.get(f"/instances/{identifier}/file").raise_for_status().content


def is_installed() -> bool:
    """Whether Orthanc, its plugin and dcmtk's storescu are there."""
    return bool(shutil.which("Orthanc") and shutil.which("storescu", path=SYSTEM_PATH)) and PLUGIN.exists()


@contextmanager
def running_orthanc(
    folder: Path, ports: tuple[int, int], service_dicom_port: int, service_http_port: int, forward: str = BY_DIMSE
) -> Iterator[Orthanc]:
    """The archive while the context lasts; what it keeps stays in the folder."""
    folder = folder.resolve()  # Orthanc takes paths for relative to the file of its settings
    folder.mkdir(parents=True, exist_ok=True)
    script = folder / "forward.lua"
    script.write_text(FORWARD % forward)
    settings = folder / "orthanc.json"
    settings.write_text(json.dumps(_settings(folder, ports, service_dicom_port, service_http_port, script)))
    with (folder / "orthanc.log").open("ab") as log:
        command = [shutil.which("Orthanc") or "Orthanc", str(settings)]
        process = subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, **PROMPT})
    try:
        address = f"http://127.0.0.1:{ports[0]}"
        with httpx.Client(base_url=address, timeout=60.0, limits=ONE_REQUEST_EACH) as client:
            _wait_until_ready(client, process)
            yield Orthanc(client, *ports)
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(STOP_LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _settings(
    folder: Path, ports: tuple[int, int], service_dicom_port: int, service_http_port: int, script: Path
) -> dict[str, Any]:
    service = f"http://127.0.0.1:{service_http_port}/dicom-web/"
    return {
        "Name": "Scene",
        "StorageDirectory": str(folder / "storage"),
        "IndexDirectory": str(folder / "storage"),
        "HttpPort": ports[0],
        "DicomPort": ports[1],
        "DicomAet": TITLE,
        "RemoteAccessAllowed": False,
        "AuthenticationEnabled": False,
        "DicomAlwaysAllowGet": True,
        "DicomAlwaysAllowStore": True,
        "OverwriteInstances": False,
        "DicomModalities": {
            "morphoflow": ["MORPHOFLOW", "127.0.0.1", service_dicom_port],
            "move": ["MORPHOMOVE", "127.0.0.1", service_dicom_port + 1],
        },
        "Plugins": [str(PLUGIN)],
        "DicomWeb": {"Enable": True, "Root": "/dicom-web/", "Servers": {"morphoflow": [service]}},
        "LuaScripts": [str(script)],
        "ConcurrentJobs": 4,
        "JobsHistorySize": 100_000,
    }


def _wait_until_ready(client: httpx.Client, process: subprocess.Popen[bytes]) -> None:
    limit = time.monotonic() + START_LIMIT_S
    while time.monotonic() < limit and process.poll() is None:
        try:
            if client.get("/system").is_success:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.05)
    raise SystemExit("Orthanc did not become ready; its log stands beside its storage.")


def send(files: list[Path] | Path, port: int, title: str = TITLE, caller: str = "SCENE") -> None:
    """Send files, or all files of a folder, with dcmtk's storescu."""
    what = ["+sd", str(files)] if isinstance(files, Path) else [str(file) for file in files]
    program = shutil.which("storescu", path=SYSTEM_PATH) or "storescu"
    # By itself it proposes a fixed list of classes, in which segmentations are missing.
    command = [program, "--required", "-aec", title, "-aet", caller, "127.0.0.1", str(port)]
    subprocess.run([*command, *what], check=True, capture_output=True, env={**os.environ, **PROMPT})
