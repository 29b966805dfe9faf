"""Learning the modes of `distance_modes` from training masks.

Masks are moved onto a common centroid, as for the project's own model, and their signed distances sampled on one
canonical grid. The fields are clipped, so that what counts is how they differ near the surface.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from model.geometry import Grid
from training.baselines.distance_modes import DistanceModes
from training.cohorts.cohort import Case
from training.distance import signed_distance
from training.placing import centroid, reach_with_voxels
from training.points import cuts_are_ends, window

#: Modes beyond this share of the variance are not kept, nor more than so many.
KEPT_SHARE, MOST_MODES = 0.995, 160
#: Grid step (mm) of a cohort: its largest half extent in so many steps, within a range.
STEPS_IN_EXTENT, STEP_RANGE_MM = 20, (1.25, 2.0)
#: Room around the largest training shape (mm).
MARGIN_MM = 6.0


def learn_modes(cases: Sequence[Case], clip_mm: float) -> DistanceModes:
    """Modes of a cohort's training masks, by a singular value decomposition of their centred fields.

    Raises:
        ValueError: fewer than two masks.
    """
    if len(cases) < 2:
        raise ValueError("Principal modes need at least two masks.")
    ends = cuts_are_ends(cases)
    grid = canonical_grid(cases)
    fields = np.stack([_field(case, grid, clip_mm, cut_is_end=ends) for case in cases])
    mean = fields.mean(axis=0)
    fields -= mean
    modes, shares = _principal(fields)
    return DistanceModes(grid, mean, modes, shares, clip_mm)


def canonical_grid(cases: Sequence[Case]) -> Grid:
    """Grid around the origin that holds every shape, moved onto its centroid, and `MARGIN_MM` more."""
    reaches = np.max([reach_with_voxels(case.mask, case.grid) for case in cases], axis=0)
    step = float(np.clip(reaches.max() / STEPS_IN_EXTENT, *STEP_RANGE_MM))
    half = np.ceil((reaches + MARGIN_MM) / step).astype(int)
    affine = np.diag([step, step, step, 1.0])
    affine[:3, 3] = -half * step
    a, b, c = (int(2 * count + 1) for count in half)
    return Grid((a, b, c), affine)


def _field(case: Case, grid: Grid, clip_mm: float, *, cut_is_end: bool) -> Float[np.ndarray, "v"]:
    """Clipped signed distance of a mask on the canonical grid, single precision."""
    found = window(case, clip_mm, cut_is_end=cut_is_end)
    distance = np.clip(signed_distance(found.mask, found.grid.spacing), -clip_mm, clip_mm)
    index = found.grid.to_index(grid.centres() + centroid(case.mask, case.grid))
    field = map_coordinates(distance, index.T, order=1, mode="constant", cval=-clip_mm)
    return np.asarray(field, np.float32)


def _principal(fields: Float[np.ndarray, "n v"]) -> tuple[Float[np.ndarray, "v k"], Float[np.ndarray, "k"]]:
    """Modes scaled to one standard deviation and cumulative shares, from the small Gram matrix of centred fields."""
    variances, vectors = np.linalg.eigh((fields @ fields.T).astype(float))
    order = np.argsort(variances)[::-1][: len(fields) - 1]
    variances, vectors = np.maximum(variances[order], 0.0), vectors[:, order]
    shares = np.cumsum(variances) / max(float(variances.sum()), 1e-12)
    count = min(int(np.searchsorted(shares, KEPT_SHARE)) + 1, len(shares), MOST_MODES)
    modes = fields.T @ (vectors[:, :count] / np.sqrt(len(fields) - 1)).astype(fields.dtype)
    return np.ascontiguousarray(modes), shares[:count]
