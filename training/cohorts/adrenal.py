"""Left and right adrenal glands from CT: AdrenalMNIST3D of MedMNIST v2, 64 voxels a side.

The archive names no person and no side, and its axes carry no world: the grid is taken as 1 mm, RAS.
Its training array is the training split, its validation array the test split. Both glands of one person
cannot be told, so that the held-out validation cases may share persons with the training cases.
"""

import zipfile
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Shaped

from model.errors import CohortError
from model.geometry import Grid
from training.cohorts.assemble import CohortOptions, assemble
from training.cohorts.cohort import Case, Cohort, Provenance

ARCHIVE = "adrenalmnist3d_64.npz"
PROVENANCE = Provenance(
    source="AdrenalMNIST3D, MedMNIST v2",
    licence="CC BY 4.0",
    attribution="MedMNIST v2 (Yang et al., Scientific Data 10, 2023), AdrenalMNIST3D from Zhongshan Hospital",
    shippable=True,
)


def load(root: Path, options: CohortOptions) -> Cohort:
    """Masks of ``root/adrenal``.

    Raises:
        CohortError: not there, not readable, or not fit to be used.
    """
    try:
        with np.load(root / "adrenal" / ARCHIVE) as archive:
            cases = [*_cases(archive["train_images"], "train"), *_cases(archive["val_images"], "test")]
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise CohortError(
            "No archive of adrenal glands was found below the data folder; name the folder with --data."
        ) from error
    return assemble("adrenal", cases, (), PROVENANCE, options, side="mixed")


def _cases(images: Shaped[np.ndarray, "n i j k"], split: Literal["train", "test"]) -> list[Case]:
    grid = Grid((images.shape[1], images.shape[2], images.shape[3]), np.eye(4))
    names = (f"adrenal_{split}_{number:04d}" for number in range(len(images)))
    return [Case(name, name, split, image != 0, grid) for name, image in zip(names, images, strict=True)]
