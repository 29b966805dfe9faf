"""Distances within a section and unequal-probability sampling, on plain arrays."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt

#: Voxels as near as this to a voxel of the other label make the band: this many in-plane voxels ...
BAND_VOXELS = 2.5
#: ... but not farther than this (mm) ...
BAND_MM = 3.0
#: ... and never fewer than this many voxels, so that coarse grids keep both sides of the contour.
NARROWEST_BAND_VOXELS = 1.5


def band_width(spacing: Float[np.ndarray, "2"]) -> float:
    """Half width (mm) of the band around a contour, for in-plane spacing in mm."""
    voxel = float(spacing.max())
    return max(NARROWEST_BAND_VOXELS * voxel, min(BAND_VOXELS * voxel, BAND_MM))


def contour_distance(
    foreground: Bool[np.ndarray, "a b"], excluded: Bool[np.ndarray, "a b"], spacing: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "a b"]:
    """In-plane distance (mm) from each voxel to the nearest annotated voxel of the other label.

    Infinite where there is none: in an empty section, or one that is foreground throughout.
    """
    background = ~foreground & ~excluded
    to_foreground = _distance_to(foreground & ~excluded, spacing)
    return np.where(foreground, _distance_to(background, spacing), to_foreground)


def _distance_to(target: Bool[np.ndarray, "a b"], spacing: Float[np.ndarray, "2"]) -> Float[np.ndarray, "a b"]:
    if not target.any():
        return np.full(target.shape, np.inf)
    return np.asarray(distance_transform_edt(~target, sampling=spacing), dtype=float)


def inclusion_probabilities(size: Float[np.ndarray, "m"], count: int) -> Float[np.ndarray, "m"]:
    """Probabilities proportional to size, none over 1, that sum to the number wanted.

    Those that would exceed 1 are certain, and the others share the rest (Brewer and Hanif 1983).
    """
    if count >= len(size):
        return np.ones(len(size))
    certain = np.zeros(len(size), dtype=bool)
    while True:
        share = (count - np.count_nonzero(certain)) / size[~certain].sum()
        above = ~certain & (size * share >= 1.0)
        if not above.any():
            return np.where(certain, 1.0, size * share)
        certain |= above


def systematic_sample(probability: Float[np.ndarray, "m"], rng: np.random.Generator) -> Int[np.ndarray, "n"]:
    """Systematic sample with the given inclusion probabilities (Madow 1949): one random start, equal steps.

    Its size is the probabilities' sum, and neighbours in the list are seldom chosen together.
    """
    wanted = round(float(probability.sum()))
    if wanted >= len(probability):
        return np.arange(len(probability))
    cumulative = np.cumsum(probability)
    chosen = np.searchsorted(cumulative, rng.random() + np.arange(wanted), side="right")
    return np.unique(np.minimum(chosen, len(probability) - 1))
