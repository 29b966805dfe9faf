"""Files of MedMNIST 3D: arrays ``train_images``, ``val_images`` and ``test_images`` of (n, i, j, k) in one NPZ archive.

The archives name no person and their axes carry no world: axes are taken as R, A and S, and the voxel size is the
caller's. Some of the sets hold grey values in place of masks (organ, nodule, fracture, synapse); these are refused.
"""

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from model.errors import CohortError
from model.geometry import Grid
from training.cohorts.assemble import CohortOptions, assemble
from training.cohorts.cohort import Case, Cohort, Provenance, Split

#: Which array belongs to which split as MedMNIST publishes them.
SPLITS: Mapping[str, Split] = {"train_images": "train", "val_images": "validation", "test_images": "test"}
PROVENANCE = Provenance("a file of MedMNIST 3D", "not stated", "MedMNIST v2 (Yang et al., 2023)", shippable=False)


def read_medmnist(path: Path, options: CohortOptions, *, spacing_mm: float = 1.0) -> Cohort:
    """A MedMNIST 3D file as a cohort.

    Raises:
        CohortError: no such file, one without masks, or what `assemble` refuses.
    """
    name = path.stem.split("_")[0]
    return assemble(name, read_arrays(path, name, spacing_mm=spacing_mm), (), PROVENANCE, options)


def read_arrays(path: Path, name: str, *, spacing_mm: float = 1.0, splits: Mapping[str, Split] = SPLITS) -> list[Case]:
    """Cases of those arrays of an archive that ``splits`` names; each case is a person of its own.

    Raises:
        CohortError: no such file, no training array, an array of another shape, or grey values.
    """
    try:
        with np.load(path) as archive:
            arrays = {key: np.asarray(archive[key]) for key in splits if key in archive.files}
    except (OSError, EOFError, ValueError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise CohortError("The MedMNIST file cannot be read; a complete NPZ archive is accepted.") from error
    if "train_images" not in arrays:
        raise CohortError("The archive holds no array train_images; a file of MedMNIST 3D is accepted.")
    return [case for key, images in arrays.items() for case in _cases(images, name, splits[key], key, spacing_mm)]


def _cases(images: Shaped[np.ndarray, "..."], name: str, split: Split, key: str, spacing_mm: float) -> Iterator[Case]:
    if images.ndim != 4:
        raise CohortError(f"The array {key} has {images.ndim} axes; masks (n, i, j, k) of MedMNIST 3D are accepted.")
    found = sorted({value for image in images for value in np.unique(image).tolist()})
    if len(found) > 2 or any(not 0 <= value < np.inf for value in found) or 0 not in (found or [0]):
        raise CohortError(
            f"The array {key} holds other values than 0 and one of the object; the sets of masks are accepted (adrenal "
            "and vessel)."
        )
    shape = (images.shape[1], images.shape[2], images.shape[3])
    grid = Grid(shape, np.diag([spacing_mm, spacing_mm, spacing_mm, 1.0]))
    for number, image in enumerate(images):
        case = f"{name}_{split}_{number:04d}"
        yield Case(case, case, split, image != 0, grid)
