"""Many studies at once while the service is killed again and again: what was acknowledged is given back, once.

python -m benchmarks.pacs storm --studies 500 --kills 10
"""

import os
import random
import shutil
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import Any, Protocol

import httpx
import numpy as np
import typer
from pydicom import Dataset
from pynetdicom import AE

from benchmarks.load.figures import Figure, holds, told
from benchmarks.pacs.drawings import EXAMPLE, as_seg, placed, series_around, three_planes
from benchmarks.pacs.orthanc import BY_DIMSE, Orthanc, running_orthanc, send
from benchmarks.pacs.stage import Place, by_dicomweb, kill, start, write_file
from benchmarks.ports import free_ports
from benchmarks.server import wait_until_ready
from model.geometry import Grid
from service.adapters.dicom.results import RESULTS
from service.adapters.pacs.prompt_sockets import PROMPT
from service.adapters.pacs.sop_classes import PROPOSED_SYNTAXES

#: Images of each study: few and thick, so that the archive's time does not hide the service's.
SHAPE, SPACING_MM = (40, 56, 14), (1.0, 1.0, 3.0)
#: Sender's wait before an object that was not acknowledged is sent again (s), and how many go into one association.
RESEND_S, AT_ONCE = 0.5, 25
#: How often images are sent to the archive, which has to hold all of them before the storm begins.
ATTEMPTS = 20
#: How often the progress is told (s).
TOLD_S = 30.0


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


class Sender(Protocol):
    """How drawings come to the service."""

    def advance(self, count: Count) -> bool:
        """Send what is not acknowledged yet; whether all is."""
        ...


class Direct:
    """The sender sends to the service itself, and again what was not acknowledged."""

    def __init__(self, drawings: Sequence[Dataset], port: int) -> None:
        self._waiting = {str(drawing.SOPInstanceUID): drawing for drawing in drawings}
        self._port = port

    def advance(self, count: Count) -> bool:
        """Send until something fails."""
        for identifier in _send(list(self._waiting.values())[:AT_ONCE], self._port, "MORPHOFLOW"):
            count.acknowledged.add(identifier)
            del self._waiting[identifier]
        return not self._waiting


class ThroughArchive:
    """dcmtk's storescu sends all to the archive, which forwards them, and again what was not acknowledged."""

    def __init__(self, drawings: Sequence[Dataset], orthanc: Orthanc, folder: Path) -> None:
        folder.mkdir(parents=True)
        for number, drawing in enumerate(drawings):
            drawing.save_as(folder / f"{number}.dcm", enforce_file_format=True)
        self._orthanc, self._studies = orthanc, len(drawings)
        self._sending = Thread(target=send, args=(folder, orthanc.dicom_port), daemon=True)

    def advance(self, count: Count) -> bool:
        """Have the archive forward again what failed."""
        if self._sending.ident is None:
            self._sending.start()
        forwards = self._orthanc.forwards()
        for identifier, state in forwards.items():
            if state == "Failure":
                self._orthanc.forward_again(identifier)
        count.acknowledged = {identifier for identifier, state in forwards.items() if state == "Success"}
        return len(count.acknowledged) == self._studies


def storm(
    folder: Path,
    studies: int,
    kills: int,
    seed: int = 0,
    say: Callable[[str], None] = print,
    *,
    direct: bool = False,
) -> Count:
    """Play it; the folder is emptied first.

    Args:
        direct: the sender sends to the service instead of to the archive, which forwards.
    """
    shutil.rmtree(folder, ignore_errors=True)
    http, dicom, own_http, own_dicom = free_ports(4)
    place = Place(folder / "service", own_http, own_dicom, workers=len(os.sched_getaffinity(0)))
    count, rng = Count(), random.Random(seed)
    forward = "do end" if direct else BY_DIMSE
    with running_orthanc(folder / "archive", (http, dicom), own_dicom, own_http, forward) as orthanc:
        write_file(place, by_dicomweb(orthanc))
        drawings = [_study(orthanc, number) for number in range(studies)]
        say(f"{studies} studies are in the archive")
        sender = Direct(drawings, own_dicom) if direct else ThroughArchive(drawings, orthanc, folder / "drawings")
        began = time.monotonic()
        _play(place, orthanc, sender, _Kills(studies, kills, rng), drawings, count, say)
        count.seconds = time.monotonic() - began
    return count


def measure(folder: Path, studies: int, kills: int) -> list[Figure]:
    """The storm's figures, through the archive."""
    count = storm(folder, studies, kills, say=typer.echo)
    complete = sum(number == len(RESULTS) for number in count.results.values())
    wanted = studies * len(RESULTS)
    return [
        told("the storm", f"{count.seconds:.0f} s, {studies / count.seconds:.2f} studies a second"),
        holds("kills of the service", str(count.kills), f"{kills}", reached=count.kills == kills),
        holds("studies acknowledged", str(len(count.acknowledged)), f"{studies}", reached=_all(count, studies)),
        holds("studies with all results", str(complete), f"{studies}", reached=complete == studies),
        holds("result objects", str(count.objects), f"{wanted}, none twice", reached=count.objects == wanted),
    ]


def _all(count: Count, studies: int) -> bool:
    return len(count.acknowledged) == studies


def _study(orthanc: Orthanc, number: int) -> Dataset:
    """Images into the archive; the drawing on them."""
    grid = Grid(SHAPE, np.diag([*SPACING_MM, 1.0]))
    images = series_around(grid, f"STORM-{number}")
    _send_all(images, orthanc.dicom_port, "ORTHANC")
    return as_seg(images, three_planes(placed(EXAMPLE, grid)))


class _Kills:
    """When the service is killed: spread at random over the progress of the whole."""

    def __init__(self, studies: int, kills: int, rng: random.Random) -> None:
        self._turns = sorted(rng.sample(range(1, 2 * studies), kills))
        self._rng = rng

    def are_due(self, progress: int) -> bool:
        """Whether the next one is; it is counted as done."""
        due = bool(self._turns) and progress >= self._turns[0]
        if due:
            self._turns.pop(0)
        return due

    @property
    def pause_s(self) -> float:
        """Time (s) that the service has after a kill before the next one can come."""
        return self._rng.uniform(1.0, 12.0) if self._turns else 0.0

    @property
    def are_over(self) -> bool:
        """Whether none is left."""
        return not self._turns


def _play(
    place: Place,
    orthanc: Orthanc,
    sender: Sender,
    kills: _Kills,
    drawings: Sequence[Dataset],
    count: Count,
    say: Callable[[str], None],
) -> None:
    # Drawings are objects of the archive too where they are sent through it.
    before = orthanc.count() + (len(drawings) if isinstance(sender, ThroughArchive) else 0)
    process = start(place)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{place.http_port}", timeout=60.0) as client:
            wait_until_ready(client, process, place.log)
            told_at = time.monotonic()
            while not (sender.advance(count) and kills.are_over and count.objects >= len(RESULTS) * len(drawings)):
                count.objects = max(0, orthanc.count() - before)
                if kills.are_due(len(count.acknowledged) + count.objects // len(RESULTS)):
                    kill(process)
                    count.kills += 1
                    say(f"kill {count.kills} at {len(count.acknowledged)} acknowledged, {count.objects} objects stored")
                    process = start(place)
                    time.sleep(kills.pause_s)
                if process.poll() is not None:
                    raise SystemExit("The service ended by itself; its log stands in its folder.")
                if time.monotonic() - told_at > TOLD_S:
                    say(f"{len(count.acknowledged)} acknowledged, {count.objects} objects stored")
                    told_at = time.monotonic()
                time.sleep(RESEND_S)
            _wait_for_the_end(client)
    finally:
        kill(process)
    _count_results(orthanc, drawings, count)


def _wait_for_the_end(client: httpx.Client) -> None:
    """Until nothing is left to be given back."""
    while "morphoflow_dicom_backlog 0.0" not in client.get("/metrics").text:
        time.sleep(RESEND_S)


def _send_all(objects: Sequence[Dataset], port: int, title: str) -> None:
    """C-STORE until every object was acknowledged: a busy archive may let an association go."""
    waiting = list(objects)
    for _ in range(ATTEMPTS):
        taken = set(_send(waiting, port, title))
        waiting = [found for found in waiting if str(found.SOPInstanceUID) not in taken]
        if not waiting:
            return
        time.sleep(RESEND_S)
    raise SystemExit(f"The archive did not take {len(waiting)} of {len(objects)} images in {ATTEMPTS} attempts.")


def _send(objects: Sequence[Dataset], port: int, title: str) -> list[str]:
    """C-STORE; UIDs of the objects that were acknowledged."""
    entity: Any = AE(ae_title="SCENE")
    for kind in {found.SOPClassUID for found in objects}:
        entity.add_requested_context(kind, list(PROPOSED_SYNTAXES))
    peer = entity.associate("127.0.0.1", port, ae_title=title, evt_handlers=[PROMPT]) if objects else None
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


def _count_results(orthanc: Orthanc, drawings: Sequence[Dataset], count: Count) -> None:
    found = orthanc.client.get("/studies", params={"expand": ""}).raise_for_status().json()
    known = {str(drawing.StudyInstanceUID) for drawing in drawings}
    sizes = orthanc.client.get("/series", params={"expand": ""}).raise_for_status().json()
    by_study: Counter[str] = Counter()
    for series in sizes:
        if "not for primary diagnosis" in series["MainDicomTags"].get("SeriesDescription", ""):
            by_study[series["ParentStudy"]] += len(series["Instances"])
    uids = {study["ID"]: study["MainDicomTags"]["StudyInstanceUID"] for study in found}
    count.results = Counter({uids[key]: number for key, number in by_study.items() if uids.get(key) in known})
    count.objects = sum(count.results.values())
