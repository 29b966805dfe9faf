"""Overlap and surface distances between two masks on one grid.

Distances are those of the `surface-distance` package: marching-cubes surface elements between the
voxels, weighted by their area (Nikolov et al., Clinically applicable segmentation of head and neck
anatomy for radiotherapy, 2021).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import surface_distance
from jaxtyping import Bool, Float


@dataclass(frozen=True)
class MaskAgreement:
    """How well two masks agree.

    Attributes:
        dice: twice the common voxels by the sum of both.
        asd_mm: average surface distance, mean of both directions.
        hd95_mm: 95th percentile of the surface distance, the larger of both directions.
        hd_mm: Hausdorff distance.
    """

    dice: float
    asd_mm: float
    hd95_mm: float
    hd_mm: float


def agreement(
    truth: Bool[np.ndarray, "i j k"], found: Bool[np.ndarray, "i j k"], spacing_mm: Float[np.ndarray, "3"]
) -> MaskAgreement:
    """All figures at once; distances are infinite when just one mask is empty and zero when both are."""
    overlap = dice(truth, found)
    if not (truth.any() and found.any()):
        distance = np.inf if truth.any() or found.any() else 0.0
        return MaskAgreement(overlap, distance, distance, distance)
    library: Any = surface_distance
    distances = library.compute_surface_distances(truth, found, tuple(map(float, spacing_mm)))
    there_and_back = library.compute_average_surface_distance(distances)
    hd95, hd = (float(library.compute_robust_hausdorff(distances, percent)) for percent in (95, 100))
    return MaskAgreement(overlap, float(np.mean(there_and_back)), hd95, hd)


def dice(a: Bool[np.ndarray, "*s"], b: Bool[np.ndarray, "*s"]) -> float:
    """Twice the common voxels by the sum of both; 1 when both are empty."""
    total = np.count_nonzero(a) + np.count_nonzero(b)
    return 2.0 * np.count_nonzero(a & b) / total if total else 1.0
