"""Vertebrae cut out of whole scans: VerSe in its layout by subject.

    <any>/derivatives/sub-verse004/sub-verse004_..._seg-vert_msk.nii.gz    vertebrae by label
    <any>/derivatives/sub-verse004/sub-verse004_..._seg-subreg_ctd.json    one centroid a vertebra, voxels of the image

Labels are 1 to 7 for C1 to C7, 8 to 19 for T1 to T12, 20 to 25 for L1 to L6 and 28 for T13. A person is a subject,
however many of its scans there are; ``<any>`` with the word training, validation or test in its name says the split. A
vertebra at the border of its scan, or one with voxels and no centroid (annotated in part), is left out.
"""

import json
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from jaxtyping import Bool, Float

from model.errors import CohortError, InputError, InvalidMask
from model.geometry import Grid
from training.cohorts.assemble import CohortOptions, assemble
from training.cohorts.cohort import Case, Cohort, Refusal, Split
from training.cohorts.inspect import bounding_box, touches_border
from training.cohorts.reading import read_labels
from training.cohorts.vertebra import VERSE

MASK, CENTROIDS = "_seg-vert_msk.nii.gz", "_seg-subreg_ctd.json"
#: L1 to L5.
LUMBAR = (20, 21, 22, 23, 24)
NAMES = {
    **{label: f"C{label}" for label in range(1, 8)},
    **{label: f"T{label - 7}" for label in range(8, 20)},
    **{label: f"L{label - 19}" for label in range(20, 26)},
    28: "T13",
}
SPLITS: tuple[tuple[str, Split], ...] = (("training", "train"), ("validation", "validation"), ("test", "test"))
#: Voxels of background kept around a vertebra, where the scan has them.
MARGIN = 4
#: A centroid may lie so far outside the box of its vertebra (voxels).
SLACK = 5.0


def read_verse(folder: Path, options: CohortOptions, *, labels: Collection[int] = ()) -> Cohort:
    """The vertebrae of these labels, L1 to L5 when none are named.

    Raises:
        CohortError: no scan in that layout, a label that no vertebra has, or what `assemble` refuses.
    """
    wanted = tuple(sorted(labels)) or LUMBAR
    unknown = [label for label in wanted if label not in NAMES]
    if unknown:
        raise CohortError(f"Label {unknown[0]} is no vertebra of VerSe; 1 to 25 and 28 are accepted.")
    scans = sorted(path for path in folder.rglob(f"*{MASK}") if not path.name.startswith("."))
    if not scans or not all(scan.parent.name.startswith("sub-") for scan in scans):
        raise CohortError(
            f"The folder holds no derivatives/sub-*/*{MASK}, or such files elsewhere; VerSe by subject is accepted."
        )
    cases: list[Case] = []
    refused: list[Refusal] = []
    for scan in scans:
        for found in _vertebrae(scan, folder, wanted):
            if isinstance(found, Case):
                cases.append(found)
            else:
                refused.append(found)
    return assemble("verse", cases, refused, VERSE, options, side="unpaired")


def split_of(scan: Path, root: Path) -> Split:
    """Split of a scan by a word in the name of a folder below the root, train when none tells.

    Words are runs of letters, so that dataset-verse19test and 03test tell, and latest does not.
    """
    folders = [re.findall("[a-z]+", part.lower()) for part in scan.relative_to(root).parts[:-1]]
    return next((split for words in reversed(folders) for word, split in SPLITS if word in words), "train")


def _vertebrae(scan: Path, root: Path, wanted: Sequence[int]) -> Iterator[Case | Refusal]:
    name = scan.name.removesuffix(MASK)
    try:
        found = read_labels(scan)
        centroids = read_centroids(scan.with_name(name + CENTROIDS), found.grid)
    except InputError as error:
        yield Refusal(name, str(error))
        return
    there = set(np.unique(found.labels).tolist())
    for label in (label for label in wanted if label in there or label in centroids):
        case = f"{name}_{NAMES[label]}"
        mask = found.labels == label
        reason, stops = objection(mask, centroids.get(label))
        if reason:
            yield Refusal(case, reason, stops=stops)
        else:
            yield Case(case, scan.parent.name, split_of(scan, root), *cut_out(mask, found.grid), found.findings)


def objection(mask: Bool[np.ndarray, "i j k"], centroid: Float[np.ndarray, "3"] | None) -> tuple[str, bool]:
    """Why a vertebra is left out (empty when it is not), and whether the caller has to agree to that."""
    if not mask.any():
        return "it has a centroid and no voxel", False
    if centroid is None:
        return "it has voxels and no centroid, so it is annotated in part", False
    if touches_border(mask):
        return "it touches the border of the scan, so part of it is missing", False
    box = np.array([[side.start, side.stop - 1] for side in bounding_box(mask)])
    if (centroid < box[:, 0] - SLACK).any() or (centroid > box[:, 1] + SLACK).any():
        return "its centroid lies outside of it; the file of centroids that belongs to the mask is accepted", True
    return "", False


def cut_out(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> tuple[Bool[np.ndarray, "a b c"], Grid]:
    """A mask that is not empty, cropped with `MARGIN`, at its place in the world."""
    box = bounding_box(mask)
    start = np.array([max(side.start - MARGIN, 0) for side in box])
    stop = np.minimum([side.stop + MARGIN for side in box], mask.shape)
    cropped = mask[tuple(slice(a, b) for a, b in zip(start, stop, strict=True))].copy()
    affine = grid.affine.astype(float).copy()
    affine[:3, 3] = grid.to_world(start[None].astype(float))[0]
    return cropped, Grid((cropped.shape[0], cropped.shape[1], cropped.shape[2]), affine)


def read_centroids(path: Path, grid: Grid) -> dict[int, Float[np.ndarray, "3"]]:
    """Centroids (voxels of the grid) by label.

    The file is a list: an optional ``direction``, the three letters of the axes that the coordinates are along (such as
    L, A, S), then ``label``, ``X``, ``Y`` and ``Z`` of each vertebra.

    Raises:
        InvalidMask: no such file, or one that is not understood.
    """
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        direction = next((tuple(entry["direction"]) for entry in entries if "direction" in entry), None)
        points = {
            int(entry["label"]): np.array([entry["X"], entry["Y"], entry["Z"]], float)
            for entry in entries
            if "label" in entry
        }
        return {label: _along_image(point, direction, grid) for label, point in points.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InvalidMask(
            f"the mask has no readable file of centroids beside it; one named like it with {CENTROIDS} is accepted",
            part="centroids",
        ) from error


def _along_image(point: Float[np.ndarray, "3"], direction: Sequence[str] | None, grid: Grid) -> Float[np.ndarray, "3"]:
    """Voxel coordinates along other axes as those of the image."""
    library: Any = nib.orientations
    if direction is None:
        return point
    image = library.io_orientation(grid.affine)
    change = library.ornt_transform(library.axcodes2ornt(direction), image)
    moved = np.empty(3)
    for axis, (target, sign) in enumerate(change):
        size = grid.shape[int(target)]
        moved[int(target)] = point[axis] if sign > 0 else size - 1 - point[axis]
    return moved
