"""Left and right adrenal glands from CT: AdrenalMNIST3D of MedMNIST v2, 64 voxels a side.

The archive names no person and no side, and its axes carry no world: the grid is taken as 1 mm, RAS.
Its training array is the training split, its validation array the test split. Both glands of one person
cannot be told, so that the held-out validation cases may share persons with the training cases.
"""

from pathlib import Path

from model.errors import CohortError
from training.cohorts.assemble import CohortOptions, assemble
from training.cohorts.cohort import Cohort, Provenance
from training.cohorts.medmnist import read_arrays

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
    path = root / "adrenal" / ARCHIVE
    if not path.is_file():
        raise CohortError("No archive of adrenal glands was found below the data folder; name the folder with --data.")
    cases = read_arrays(path, "adrenal", splits={"train_images": "train", "val_images": "test"})
    return assemble("adrenal", cases, (), PROVENANCE, options, side="mixed")
