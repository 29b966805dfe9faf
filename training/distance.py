"""Signed distance to the border of a binary mask, in a plane or in space."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt


def signed_distance(mask: Bool[np.ndarray, "*s"], spacing: Float[np.ndarray, "n"]) -> Float[np.ndarray, "*s"]:
    """Distance (mm) to the border between the voxels, positive inside; an empty mask is far outside everywhere.

    What lies beyond the array is background.
    """
    if not mask.any():
        return np.full(mask.shape, -float(np.linalg.norm(np.array(mask.shape) * spacing)))
    within = tuple(slice(1, -1) for _ in mask.shape)
    inside = distance_transform_edt(np.pad(mask, 1), spacing)[within]
    outside = distance_transform_edt(~mask, spacing)
    half = spacing.min() / 2.0
    return np.asarray(np.where(mask, inside - half, half - outside))
