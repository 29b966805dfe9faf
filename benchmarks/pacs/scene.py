"""The scene: a radiographer draws three planes, sends the drawing to the archive, and finds results in the study.

python -m benchmarks.pacs scene
"""

import gzip
import io
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import httpx
import nibabel as nib
import numpy as np
from jaxtyping import Bool
from pydicom import Dataset, dcmread
from rich.console import Console
from rich.table import Table

from benchmarks.load.figures import Figure, at_most, holds
from benchmarks.pacs.drawings import EXAMPLE, as_seg, placed, real_series, series_around, three_planes
from benchmarks.pacs.orthanc import BY_DICOMWEB, BY_DIMSE, Orthanc, is_installed, running_orthanc, send
from benchmarks.pacs.stage import Place, by_dicomweb, by_dimse, running_service, write_file
from benchmarks.ports import free_ports
from model.geometry import Grid
from service.adapters.dicom.masks import stacks_of_object
from service.adapters.dicom.results import RESULTS
from service.adapters.dicom.series import series_of
from service.adapters.image_guard import ImageLimits
from service.adapters.images import write_nifti
from training.metrics_masks import dice

LIMITS = ImageLimits(max_bytes=1 << 28, max_voxels=1 << 27)
#: The results have to be in the archive after so long (s).
LIMIT_S = 5.0
#: Longest wait for the results (s).
PATIENCE_S = 120.0
#: Largest difference in Dice between what the archive and what REST gives back.
SAME_DICE = 0.002


@dataclass(frozen=True)
class Scene:
    """What was seen.

    Attributes:
        seconds: from the drawing's sending to the last result in the archive.
        kinds: modality and description of each result series.
        errors: what dciodvfy holds against each result.
        dice_archive, dice_rest: of the segmentations that came back, with the whole object.
        results: result objects in the study.
    """

    seconds: float
    kinds: tuple[str, ...]
    errors: tuple[str, ...]
    dice_archive: float
    dice_rest: float
    results: int

    @property
    def is_right(self) -> bool:
        """Whether all results are there, valid, and the same as by REST."""
        same = abs(self.dice_archive - self.dice_rest) <= SAME_DICE
        return self.results == len(RESULTS) and not self.errors and same


def play(folder: Path, data: Path | None = None, *, dicomweb: bool = False) -> Scene:
    """Start archive and service, play the scene, print the study's content."""
    if not is_installed():
        raise SystemExit("Orthanc with DICOMweb and dcmtk are needed (Debian: orthanc orthanc-dicomweb dcmtk).")
    shutil.rmtree(folder, ignore_errors=True)
    images, whole = _study(data)
    drawing, grid = as_seg(images, three_planes(whole)), series_of(images).grid
    http, dicom, own_http, own_dicom = free_ports(4)
    place = Place(folder / "service", own_http, own_dicom)
    forward = BY_DICOMWEB if dicomweb else BY_DIMSE
    with running_orthanc(folder / "archive", (http, dicom), own_dicom, own_http, forward) as orthanc:
        write_file(place, by_dicomweb(orthanc) if dicomweb else by_dimse(orthanc))
        with running_service(place) as client:
            _wait_for_worker(place)
            files = _files(folder / "images", images)
            send(files, orthanc.dicom_port)
            (drawn,) = _files(folder / "drawing", [drawing])
            began = time.monotonic()
            send([drawn], orthanc.dicom_port)
            _wait_for_objects(orthanc, len(images) + 1 + len(RESULTS))
            seconds = time.monotonic() - began
            found = _results(orthanc, drawing)
            rest = _by_rest(client, three_planes(whole), grid)
    scene = _judge(seconds, found, whole, rest, grid, folder)
    _show(scene, images, drawing, found)
    return scene


def measure(folder: Path, forward: str = BY_DIMSE) -> list[Figure]:
    """The scene's figures, by DIMSE or by DICOMweb."""
    scene = play(folder, dicomweb=forward == BY_DICOMWEB)
    difference = abs(scene.dice_archive - scene.dice_rest)
    return [
        at_most("results in the study after", scene.seconds, LIMIT_S, " s", 1),
        holds("result objects", str(scene.results), f"{len(RESULTS)}", reached=scene.results == len(RESULTS)),
        holds("errors that the checker finds", str(len(scene.errors)), "none", reached=not scene.errors),
        at_most("difference in Dice to the result by REST", difference, SAME_DICE, digits=4),
    ]


def _study(data: Path | None) -> tuple[list[Dataset], Bool[np.ndarray, "i j k"]]:
    """A real series and a test hippocampus where the cohorts lie at hand, else the example on a series of its own."""
    return _example() if data is None else _real_study(data) or _example()


def _real_study(data: Path) -> tuple[list[Dataset], Bool[np.ndarray, "i j k"]] | None:
    series, masks = data / "dicom" / "study1", sorted((data / "hippocampus" / "test").glob("*.nii.gz"))
    if not (series.is_dir() and masks):
        return None
    images = real_series(series)
    return images, placed(masks[0], series_of(images).grid)


def _example() -> tuple[list[Dataset], Bool[np.ndarray, "i j k"]]:
    loaded = nib.Nifti1Image.from_filename(EXAMPLE)
    columns, rows, planes = loaded.shape
    grid = Grid((columns, rows, planes), np.asarray(loaded.affine, float))
    return series_around(grid), np.asarray(loaded.dataobj) > 0


def _files(folder: Path, objects: Sequence[Dataset]) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{number}.dcm" for number in range(len(objects))]
    for path, found in zip(paths, objects, strict=True):
        found.save_as(path, enforce_file_format=True)
    return paths


def _wait_for_worker(place: Place) -> None:
    limit = time.monotonic() + PATIENCE_S
    while "worker started" not in (place.folder / "service.log").read_text() and time.monotonic() < limit:
        time.sleep(0.1)


def _wait_for_objects(orthanc: Orthanc, count: int) -> None:
    """Until the archive holds so many objects; asked for seldom enough to leave the machine to those who work."""
    limit = time.monotonic() + PATIENCE_S
    while orthanc.count() < count and time.monotonic() < limit:
        time.sleep(0.05)


def _results(orthanc: Orthanc, drawing: Dataset) -> list[Dataset]:
    """The results in the archive."""
    series = {s["ID"] for s in orthanc.series() if "not for primary diagnosis" in s.get("SeriesDescription", "")}
    found = [item for item in orthanc.instances(drawing.StudyInstanceUID) if item["ParentSeries"] in series]
    return [dcmread(io.BytesIO(orthanc.file(item["ID"]))) for item in found]


def _by_rest(client: httpx.Client, drawn: Bool[np.ndarray, "i j k"], grid: Grid) -> Bool[np.ndarray, "i j k"]:
    """The segmentation that the interface gives for the same planes, sent as NIfTI."""
    mask = write_nifti(drawn.astype(np.uint8), grid, "three planes")
    made = client.post("/v1/reconstructions", files={"mask": mask}, data={"model": "hippocampus"})
    address = made.raise_for_status().json()["links"]["segmentation"]
    answer = client.get(address).raise_for_status().content
    return np.asarray(nib.Nifti1Image.from_bytes(gzip.decompress(answer)).dataobj) > 0


def _judge(
    seconds: float,
    found: Sequence[Dataset],
    whole: Bool[np.ndarray, "i j k"],
    rest: Bool[np.ndarray, "i j k"],
    grid: Grid,
    folder: Path,
) -> Scene:
    segmentations = [item for item in found if "SegmentationType" in item]
    archived = np.zeros(grid.shape, bool)
    for item in segmentations:
        archived |= stacks_of_object(item, "result", LIMITS, home=grid)[0].foreground
    kinds = tuple(sorted(f"{item.Modality}: {item.SOPClassUID.name}" for item in found))
    errors = tuple(error for item in found for error in checker_errors(item, folder))
    return Scene(seconds, kinds, errors, dice(archived, whole), dice(rest, whole), len(found))


def checker_errors(found: Dataset, folder: Path) -> list[str]:
    """What dciodvfy (Debian: dicom3tools) holds against an object; nothing where it is not installed."""
    checker = shutil.which("dciodvfy")
    if checker is None:
        return []
    path = folder / "checked.dcm"
    found.save_as(path, enforce_file_format=True)
    run = subprocess.run([checker, path], capture_output=True, text=True, check=False)
    return [line for line in (run.stdout + run.stderr).splitlines() if line.startswith("Error")]


def _show(scene: Scene, images: Sequence[Dataset], drawing: Dataset, found: Sequence[Dataset]) -> None:
    table = Table("modality", "object", "series", title="The study in the archive")
    table.add_row(images[0].Modality, f"{len(images)} images", str(images[0].get("SeriesDescription", "")))
    table.add_row(drawing.Modality, "drawing on three planes", str(drawing.get("SeriesDescription", "")))
    for item in sorted(found, key=lambda item: (item.SeriesNumber, item.InstanceNumber)):
        table.add_row(item.Modality, item.SOPClassUID.name, item.SeriesDescription)
    console = Console()
    console.print(table)
    console.print(f"{scene.results} results, {scene.seconds:.1f} s after the drawing was sent to the archive")
    console.print(f"errors that dciodvfy finds: {len(scene.errors)}")
    console.print(f"Dice with the whole object: {scene.dice_archive:.4f} in the archive, {scene.dice_rest:.4f} by REST")
    for error in scene.errors:
        console.print(error)
