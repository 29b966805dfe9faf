"""Labelled points of training masks in the canonical frame.

Each mask is moved so that the centroid of its foreground is the origin: the placement of training masks is
taken as known, while orientation and size stay as they are. Everything outside the crop is background, except
beyond a face of the crop that cuts the object off: nothing is said there. Distances suit organs; those of an object
shorter than `SMALL_MM` shrink along with it.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt

from model.geometry import Grid
from training.cohorts.cohort import Case
from training.cohorts.inspect import bounding_box, cut_faces, extent_mm, touches_border
from training.placing import centroid
from training.samples import ShapePoints
from training.sparsify import Drawing, Regime, for_training

#: Points within this distance of the contour are near (mm), or within so many voxels where they are larger.
BAND_MM, BAND_VOXELS = 3.0, 1.5
#: Background voxels around the object's box (mm).
MARGIN_MM = 8.0
#: Objects shorter than this have a narrower band and margin.
SMALL_MM = 20.0
#: Random background points beyond that margin, a shape.
FAR_COVER = 2000
#: Points kept for all shapes together, and for one.
TOTAL_POINTS = 20_000_000
POINTS_RANGE = (20_000, 200_000)
#: Points inside the object that a shape keeps at least, if its drawing has them.
LEAST_INSIDE = 50
#: The decoder's cube is this much larger than the largest training shape.
EXTENT_FACTOR = 1.25


@dataclass(frozen=True)
class Window:
    """A mask cropped to its object and a margin.

    Attributes:
        mask: (i, j, k) voxels of the object.
        grid: their place in the world (RAS mm).
        unknown: (i, j, k) voxels beyond a face of the original crop that cuts the object off.
    """

    mask: Bool[np.ndarray, "i j k"]
    grid: Grid
    unknown: Bool[np.ndarray, "i j k"]


def window(case: Case, margin_mm: float = MARGIN_MM, *, cut_is_end: bool = False) -> Window:
    """Crop to the object with a margin of background, or of unknown voxels where the crop cuts it off.

    Args:
        margin_mm: of objects that are not small (`reduction`).
        cut_is_end: the object ends at the crop by definition, as a bone cut to a length does.
    """
    box = bounding_box(case.mask)
    pad = np.ceil(margin_mm * reduction(case.mask, case.grid) / case.grid.spacing).astype(int)
    widths = [(int(width), int(width)) for width in pad]
    mask = np.pad(case.mask[box], widths)
    unknown = np.zeros(mask.shape, bool)
    for axis, (first, last) in enumerate(cut_faces(case.mask).T & (not cut_is_end)):
        along = np.moveaxis(unknown, axis, 0)
        along[: pad[axis]] |= first
        along[len(along) - pad[axis] :] |= last
    affine = case.grid.affine.astype(float).copy()
    affine[:3, 3] = case.grid.to_world(np.array([[side.start for side in box] - pad], float))[0]
    return Window(mask, Grid((mask.shape[0], mask.shape[1], mask.shape[2]), affine), unknown)


def reduction(mask: Bool[np.ndarray, "i j k"], grid: Grid) -> float:
    """Factor on distances of an object: 1 from `SMALL_MM` on, and its share of that below."""
    return min(1.0, extent_mm(mask, grid) / SMALL_MM)


def cuts_are_ends(cases: Sequence[Case]) -> bool:
    """Whether a cut counts as the object's end: where most of the masks touch their crops, as cut bones do."""
    return 2 * sum(touches_border(case.mask) for case in cases) > len(cases)


def cohort_points(
    cases: Sequence[Case], regime: Regime, seed: int, threads: int = 1, *, cut_is_end: bool | None = None
) -> list[ShapePoints]:
    """Points of all shapes; a pure function of cases, regime and seed, whatever the number of threads.

    Args:
        cut_is_end: see `window`; what `cuts_are_ends` says of the cases when None.
    """
    ends = cuts_are_ends(cases) if cut_is_end is None else cut_is_end
    limit = int(np.clip(TOTAL_POINTS // max(len(cases), 1), *POINTS_RANGE))

    def points_of(case: Case, rng: np.random.Generator) -> ShapePoints:
        return shape_points(window(case, cut_is_end=ends), regime, rng, limit)

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(points_of, cases, np.random.default_rng(seed).spawn(len(cases))))


def shape_points(found: Window, regime: Regime, rng: np.random.Generator, limit: int) -> ShapePoints:
    """Points of one random drawing, at most ``limit`` and a thin cover of the far background."""
    drawing = for_training(found.mask, found.grid, regime, rng)
    near = near_contour(drawing, regime, BAND_MM * reduction(found.mask, found.grid))
    index = _kept(rng.permutation(np.argwhere(_known(drawing, found))), drawing.stack.foreground, limit)
    world = np.concatenate([drawing.stack.grid.to_world(index.astype(float)), _far_cover(found, rng)])
    at = tuple(index.T)
    background = np.zeros(len(world) - len(index), bool)
    centre = centroid(found.mask, found.grid)
    return ShapePoints(
        (world - centre).astype(np.float32),
        np.concatenate([drawing.stack.foreground[at], background]),
        np.concatenate([near[at], background]),
    )


def near_contour(drawing: Drawing, regime: Regime, band_mm: float = BAND_MM) -> Bool[np.ndarray, "i j k"]:
    """Voxels within the band around the contour: in space for dense masks, in the drawn planes otherwise.

    The band has `BAND_VOXELS` of the finer ones of those spacings at least.
    """
    foreground, spacing = drawing.stack.foreground, drawing.stack.grid.spacing
    if regime == "dense":
        return _within(foreground, spacing, band_mm)
    near = np.zeros(foreground.shape, bool)
    for plane in drawing.planes:
        section = np.moveaxis(foreground, plane.axis, 0)[plane.index]
        along = np.moveaxis(near, plane.axis, 0)
        along[plane.index] |= _within(section, np.delete(spacing, plane.axis), band_mm)
    return near


def decoder_extent(points: Sequence[ShapePoints]) -> float:
    """Half size of a canonical cube that holds every training shape with room to spare (mm)."""
    reach = max(float(np.abs(shape.points[shape.labels]).max()) for shape in points)
    return float(np.ceil(EXTENT_FACTOR * reach))


def _within(inside: Bool[np.ndarray, "*s"], spacing: Float[np.ndarray, "n"], band_mm: float) -> Bool[np.ndarray, "*s"]:
    """Whether the nearest voxel of the other kind is near."""
    return np.asarray(_distance(inside, spacing) <= max(band_mm, BAND_VOXELS * float(spacing.min())))


def _distance(inside: Bool[np.ndarray, "*s"], spacing: Float[np.ndarray, "n"]) -> Float[np.ndarray, "*s"]:
    """Distance to the nearest voxel of the other kind (mm); infinite when there is none."""
    if inside.all() or not inside.any():
        return np.full(inside.shape, np.inf)
    distance = np.where(inside, distance_transform_edt(inside, spacing), distance_transform_edt(~inside, spacing))
    return np.asarray(distance)


def _known(drawing: Drawing, found: Window) -> Bool[np.ndarray, "i j k"]:
    """Voxels that the drawing tells of; those of the object too where all its slices stand beyond a cut."""
    known = drawing.annotated & ~_unknown_on(drawing.stack.grid, found)
    inside = drawing.stack.foreground
    return np.asarray(known if (known & inside).any() else known | inside)


def _kept(index: Int[np.ndarray, "n 3"], inside: Bool[np.ndarray, "i j k"], limit: int) -> Int[np.ndarray, "m 3"]:
    """The first voxels up to a limit, with `LEAST_INSIDE` of the object among them if there are so many."""
    kept, more = index[:limit], index[limit:]
    count = min(LEAST_INSIDE, limit) - int(inside[tuple(kept.T)].sum())
    if count <= 0:
        return kept
    more = more[inside[tuple(more.T)]][:count]
    spare = np.flatnonzero(~inside[tuple(kept.T)])[::-1][: len(more)]
    return np.concatenate([np.delete(kept, spare, axis=0), more])


def _unknown_on(grid: Grid, found: Window) -> Bool[np.ndarray, "i j k"]:
    """The window's unknown voxels on a drawing's own grid, by the nearest voxel."""
    if not found.unknown.any():
        return np.zeros(grid.shape, bool)
    centres = np.indices(grid.shape).reshape(3, -1).T.astype(float)
    index = np.rint(found.grid.to_index(grid.to_world(centres))).astype(int)
    index = np.clip(index, 0, np.array(found.grid.shape) - 1)
    return np.asarray(found.unknown[tuple(index.T)].reshape(grid.shape))


def _far_cover(found: Window, rng: np.random.Generator) -> Float[np.ndarray, "n 3"]:
    """Random world points around the window, where the object cannot be."""
    size = np.array(found.grid.shape)
    index = rng.uniform(-0.5, 1.5, (FAR_COVER, 3)) * size
    nearest = np.clip(np.rint(index), 0, size - 1).astype(int)
    outside = ((index < 0) | (index > size - 1)).any(axis=1)
    return found.grid.to_world(index[outside & ~found.unknown[tuple(nearest.T)]])
