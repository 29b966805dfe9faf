"""Many studies at once while the service is killed again and again: what was acknowledged is given back, once.

python -m benchmarks.pacs storm --studies 500 --kills 10
"""

import random
import shutil
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from pydicom import Dataset
from pynetdicom import AE

from benchmarks.pacs.drawings import EXAMPLE, as_seg, placed, series_around, three_planes
from benchmarks.pacs.orthanc import Orthanc, free_ports, running_orthanc
from benchmarks.pacs.stage import Place, by_dicomweb, kill, start, write_file
from benchmarks.server import wait_until_ready
from model.geometry import Grid
from service.adapters.dicom.results import RESULTS
from service.adapters.pacs.sop_classes import PROPOSED_SYNTAXES

#: Images of each study: few and thick, so that the archive's time does not hide the service's.
SHAPE, SPACING_MM = (40, 56, 14), (1.0, 1.0, 3.0)
#: Sender's wait before an object that was not acknowledged is sent again (s).
RESEND_S = 0.5


@dataclass
class Count:
    """What happened.

    Attributes:
        acknowledged: SOP Instance UIDs of drawings that the service said it has.
        kills: how often it was killed.
        seconds: from the first object sent to the last result seen.
    """

    acknowledged: set[str] = field(default_factory=set)
    kills: int = 0
    seconds: float = 0.0
    results: Counter[str] = field(default_factory=Counter)
    objects: int = 0

    def sentence(self, studies: int) -> str:
        """For people."""
        complete = sum(number == len(RESULTS) for number in self.results.values())
        return (
            f"{studies} studies sent, {len(self.acknowledged)} acknowledged, {self.kills} kills: "
            f"{complete} studies with all {len(RESULTS)} results, {self.objects} result objects, "
            f"{studies - complete} studies lacking some, {max(0, self.objects - studies * len(RESULTS))} too many, "
            f"in {self.seconds:.0f} s"
        )


def storm(folder: Path, studies: int, kills: int, seed: int = 0, say: Callable[[str], None] = print) -> Count:
    """Play it; the folder is emptied first."""
    shutil.rmtree(folder, ignore_errors=True)
    http, dicom, own_http, own_dicom = free_ports(4)
    place = Place(folder / "service", own_http, own_dicom)
    count, rng = Count(), random.Random(seed)
    with running_orthanc(folder / "archive", (http, dicom), own_dicom, own_http, "do end") as orthanc:
        write_file(place, by_dicomweb(orthanc))
        drawings = [_study(orthanc, number) for number in range(studies)]
        say(f"{studies} studies are in the archive")
        began = time.monotonic()
        _play(place, orthanc, drawings, kills, rng, count, say)
        count.seconds = time.monotonic() - began
    return count


def _study(orthanc: Orthanc, number: int) -> Dataset:
    """Images into the archive; the drawing on them."""
    grid = Grid(SHAPE, np.diag([*SPACING_MM, 1.0]))
    images = series_around(grid, f"STORM-{number}")
    _send(images, orthanc.dicom_port, "ORTHANC")
    return as_seg(images, three_planes(placed(EXAMPLE, grid)))


def _play(
    place: Place,
    orthanc: Orthanc,
    drawings: Sequence[Dataset],
    kills: int,
    rng: random.Random,
    count: Count,
    say: Callable[[str], None],
) -> None:
    turns = sorted(rng.sample(range(1, 2 * len(drawings)), kills))
    waiting = {str(drawing.SOPInstanceUID): drawing for drawing in drawings}
    process, images = start(place), _instances(orthanc)
    with httpx.Client(base_url=f"http://127.0.0.1:{place.http_port}", timeout=60.0) as client:
        wait_until_ready(client, process, place.log)
        while True:
            _send_some(waiting, place.dicom_port, count)
            count.objects = _instances(orthanc) - images
            progress = len(count.acknowledged) + count.objects // len(RESULTS)
            if turns and progress >= turns[0]:
                turns.pop(0)
                kill(process)
                count.kills += 1
                say(f"kill {count.kills} at {len(count.acknowledged)} acknowledged, {count.objects} objects stored")
                process = start(place)
                time.sleep(rng.uniform(1.0, 12.0) if turns else 0.0)
            if not waiting and not turns and count.objects >= len(RESULTS) * len(drawings):
                break
            if process.poll() is not None:
                raise SystemExit("The service ended by itself; its log stands in its folder.")
            time.sleep(RESEND_S)
        _wait_for_the_end(client)
    kill(process)
    _count_results(orthanc, drawings, count)


def _wait_for_the_end(client: httpx.Client) -> None:
    """Until nothing is left to be given back."""
    while "morphoflow_dicom_backlog 0.0" not in client.get("/metrics").text:
        time.sleep(RESEND_S)


def _send_some(waiting: dict[str, Dataset], port: int, count: Count, most: int = 25) -> None:
    """Send until something fails; what is not acknowledged is sent again later, as archives do."""
    for identifier in _send(list(waiting.values())[:most], port, "MORPHOFLOW"):
        count.acknowledged.add(identifier)
        del waiting[identifier]


def _send(objects: Sequence[Dataset], port: int, title: str) -> list[str]:
    """C-STORE; UIDs of the objects that were acknowledged."""
    entity: Any = AE(ae_title="SCENE")
    for kind in {found.SOPClassUID for found in objects}:
        entity.add_requested_context(kind, list(PROPOSED_SYNTAXES))
    peer = entity.associate("127.0.0.1", port, ae_title=title) if objects else None
    if peer is None or not peer.is_established:
        return []
    taken = []
    for found in objects:
        try:
            if peer.send_c_store(found).get("Status") != 0:
                break
        except RuntimeError:  # the association is gone
            break
        taken.append(str(found.SOPInstanceUID))
    peer.release()
    return taken


def _instances(orthanc: Orthanc) -> int:
    return int(orthanc.client.get("/statistics").raise_for_status().json()["CountInstances"])


def _count_results(orthanc: Orthanc, drawings: Sequence[Dataset], count: Count) -> None:
    found = orthanc.client.get("/studies", params={"expand": ""}).raise_for_status().json()
    known = {str(drawing.StudyInstanceUID) for drawing in drawings}
    sizes = orthanc.client.get("/series", params={"expand": ""}).raise_for_status().json()
    by_study: Counter[str] = Counter()
    for series in sizes:
        if series["MainDicomTags"].get("Modality") != "MR":
            by_study[series["ParentStudy"]] += len(series["Instances"])
    uids = {study["ID"]: study["MainDicomTags"]["StudyInstanceUID"] for study in found}
    count.results = Counter({uids[key]: number for key, number in by_study.items() if uids.get(key) in known})
    count.objects = sum(count.results.values())
