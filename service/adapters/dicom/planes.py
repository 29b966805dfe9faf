"""How planes of image frames lie together: from LPS to voxel grids in RAS (PS3.3, C.7.6.2).

Pixels are counted along a row first: index axes are column, row and plane, as in the voxel grids of
`model.geometry`.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from model.errors import InvalidGeometry
from model.geometry import Grid, slab
from service.adapters.dicom.frame_planes import FramePlane
from service.adapters.dicom.plane_groups import REGULAR_SHARE, unlike_the_first
from service.adapters.image_guard import LPS_TO_RAS

#: Share by which the nominal distance of planes may be rounded.
NOMINAL_SHARE = 0.01
#: Distance of a drawn plane from its place that is rounded away (mm); also that of planes at one place.
REGULAR_MM = 0.02
#: A distance of this many usual ones lacks a plane.
GAP = 1.5
#: No step below this is tried for irregular planes (mm), unless planes are nearer to each other.
FINEST_MM = 0.1
#: Steps tried for irregular planes, at most: their smallest distance through 1, 2, ... so many.
MOST_PARTS = 10_000
#: Counts that differ by less than this are equal.
ROUNDING = 1e-6
#: Planes named in a message, at most.
LISTED_PLANES = 4


@dataclass(frozen=True)
class ImageGrid(Grid):
    """The voxel grid of images (RAS) and the frame of reference that its world is; empty when the images name none."""

    frame_of_reference: str = ""


@dataclass(frozen=True)
class DrawnStack:
    """A voxel grid (RAS) through planes of a drawing.

    Attributes:
        numbers: of the planes, as they were given.
        places: index of each along the grid's last axis.
    """

    grid: Grid
    numbers: Int[np.ndarray, "n"]
    places: Int[np.ndarray, "n"]


def stack_places(planes: Sequence[FramePlane], finest_mm: float = 0.0) -> tuple[Int[np.ndarray, "n"], float] | None:
    """Place of each plane of a sparse drawing in a regular stack from 0 on, and the stack's step (mm).

    Tried are the planes' nominal distance and parts of their smallest one, from the coarsest on. Each is fitted to
    the planes, so that rounded positions do not add up. The planes lie within `REGULAR_MM` of their places.

    Args:
        finest_mm: no step below this is tried, as it would take too many planes, but one that the planes state.

    Returns:
        None where no step fits the planes.
    """
    up, depth = _heights(planes), _depth(planes)
    near = _near_mm(depth)
    distances = np.diff(np.unique(up))
    smallest = float(distances.min(initial=np.inf, where=distances > near))
    if not np.isfinite(smallest):
        return np.zeros(len(planes), int), depth
    nominal = [(depth, NOMINAL_SHARE)] if depth >= finest_mm or any(_stated_depths(planes)) else []
    for step, share in (*nominal, *((part, REGULAR_SHARE) for part in _parts(smallest, finest_mm))):
        places, fitted = _fitted(up, step)
        if abs(fitted - step) <= share * step and np.abs(up - places * fitted).max() <= near:
            return places, fitted
    return None


def _heights(planes: Sequence[FramePlane]) -> Float[np.ndarray, "n"]:
    """Heights of parallel planes above the lowest one (mm)."""
    heights = np.array([planes[0].offset(plane)[2] for plane in planes])
    return np.asarray(heights - heights.min())


def _near_mm(depth: float) -> float:
    """Distance (mm) of planes at one place, whose nominal distance is known."""
    return min(REGULAR_MM, depth / 2)


def _parts(smallest: float, finest_mm: float) -> Iterator[float]:
    """The smallest distance of planes through 1, 2, ..., down to the finest step."""
    finest = max(min(smallest, FINEST_MM), finest_mm)
    count = min(int(smallest / finest + ROUNDING), MOST_PARTS)
    yield from (smallest / number for number in range(1, count + 1))


def _fitted(up: Float[np.ndarray, "n"], step: float) -> tuple[Int[np.ndarray, "n"], float]:
    """Places by the distance from each plane to the next one, and the step that takes the last plane to its place."""
    order = np.argsort(up)
    places = np.zeros(len(up), int)
    places[order] = np.cumsum(np.rint(np.diff(up[order], prepend=0.0) / step)).astype(int)
    return places, float(up.max() / places.max()) if places.max() else step


def _depth(planes: Sequence[FramePlane]) -> float:
    """Nominal distance between planes (mm); their finer pixel spacing when none says it."""
    return next(_stated_depths(planes), min(planes[0].spacing))


def _stated_depths(planes: Sequence[FramePlane]) -> Iterator[float]:
    """Nominal distances (mm) that planes say."""
    return (plane.depth for plane in planes if np.isfinite(plane.depth) and plane.depth > 0)


def complete_places(planes: Sequence[FramePlane], part: str) -> tuple[Int[np.ndarray, "n"], float]:
    """Place of each plane of a stack without gaps, and the stack's step (mm): its length through its distances.

    Raises:
        InvalidGeometry: planes of several directions or pixel sizes, shifted against each other (a tilted
            gantry), at one place, missing, or at unequal distances.
    """
    heights = np.array([planes[0].offset(plane)[2] for plane in planes])
    order = np.argsort(heights, kind="stable")
    fault = _fault([planes[number] for number in order])
    if fault:
        raise InvalidGeometry(
            f"The {part} is no regular stack of planes: {fault}; parallel planes at equal distances that are not "
            "shifted against each other are accepted",
            part=part,
        )
    step = float(np.ptp(heights)) / (len(planes) - 1) if len(planes) > 1 else _depth(planes)
    return np.argsort(order), step


def _fault(planes: Sequence[FramePlane]) -> str | None:
    """What keeps planes, in order, from being a regular stack; they are counted from 1."""
    count, first = len(planes), planes[0]
    unlike = [number + 1 for number in unlike_the_first(planes)]
    if unlike:
        return f"plane {_listed(unlike)} of {count} differs from the first in its direction or the size of its pixels"
    offsets = np.array([first.offset(plane) for plane in planes])
    return (_distance_fault(offsets[:, 2]) if count > 1 else None) or _shift_fault(offsets[:, :2] / first.spacing)


def _distance_fault(heights: Float[np.ndarray, "n"]) -> str | None:
    count, gaps = len(heights), np.diff(heights)
    doubled = gaps <= min(REGULAR_MM, REGULAR_SHARE * gaps.max())
    if doubled.any():
        return f"planes {_pairs(doubled)} of {count} lie at one place (doubled)"
    lacking = gaps > GAP * np.median(gaps)
    if lacking.any():
        return f"planes are missing between planes {_pairs(lacking)} of {count}"
    step = gaps.mean()
    if np.abs(heights - heights[0] - step * np.arange(count)).max() > REGULAR_SHARE * step:
        return f"the distances of its planes vary from {gaps.min():.3g} to {gaps.max():.3g} mm"
    return None


def _shift_fault(shifts: Float[np.ndarray, "n 2"]) -> str | None:
    """Of planes at equal distances; shifts along rows and columns in pixels."""
    if np.ptp(shifts, axis=0).max() <= 2 * REGULAR_SHARE:
        return None
    off = np.flatnonzero(np.abs(shifts - np.median(shifts, axis=0)).max(axis=1) > REGULAR_SHARE) + 1
    if 2 * len(off) < len(shifts):
        return f"plane {_listed(off)} of {len(shifts)} is shifted along its rows or columns"
    return "its planes are shifted against each other along their rows or columns, as with a tilted gantry"


def _pairs(gaps: Bool[np.ndarray, "n"]) -> str:
    return _listed([f"{number + 1} and {number + 2}" for number in np.flatnonzero(gaps)])


def _listed(names: Iterable[object]) -> str:
    every = [str(name) for name in names]
    rest = len(every) - LISTED_PLANES
    return ", ".join(every[:LISTED_PLANES]) + (f" and {rest} more" if rest > 0 else "")


def drawn_stacks(
    planes: Sequence[FramePlane], columns: int, rows: int, most_voxels: float, room_mm: float = 0.0
) -> list[DrawnStack]:
    """Voxel grids (RAS) on which parallel drawn planes in register lie where they were drawn, to within `REGULAR_MM`.

    It is one grid where a step fits all of the planes. Otherwise each plane is a stack by itself, and the first, which
    is the lowest, reaches past all of them, so that maps on its grid hold the whole object.

    Args:
        most_voxels: a step that would take more of them is not tried for irregular planes.
        room_mm: before the first plane and behind the last.
    """
    up, depth = _heights(planes), _depth(planes)
    levels = _levels(up, _near_mm(depth))
    length = float(up.max()) + 2 * room_mm
    finest = length / max(most_voxels / (columns * rows) - len(levels) - 3, ROUNDING)
    regular = stack_places(planes, finest)
    if regular is not None:
        grid = grid_at(planes, *regular, columns, rows)
        return [_longer(DrawnStack(grid, np.arange(len(planes)), regular[0]), room_mm, room_mm)]
    step = max(depth, finest)
    lowest, *others = (_flat_stack(planes, numbers, step, columns, rows) for numbers in levels)
    return [_longer(lowest, room_mm, length - room_mm), *others]


def _levels(up: Float[np.ndarray, "n"], near: float) -> list[Int[np.ndarray, "_"]]:
    """Numbers of the planes at each place, from the lowest to the highest."""
    order = np.argsort(up, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(up[order]) > near) + 1)


def _flat_stack(
    planes: Sequence[FramePlane], numbers: Int[np.ndarray, "n"], step: float, columns: int, rows: int
) -> DrawnStack:
    """Planes at one place as a stack of one plane."""
    chosen, places = [planes[number] for number in numbers], np.zeros(len(numbers), int)
    return DrawnStack(grid_at(chosen, places, step, columns, rows), numbers, places)


def _longer(stack: DrawnStack, before_mm: float, behind_mm: float) -> DrawnStack:
    """The stack with more planes before its first and behind its last one, over lengths at least so long."""
    step = stack.grid.spacing[2]
    before, behind = (int(np.ceil(length / step - ROUNDING)) for length in (before_mm, behind_mm))
    affine = stack.grid.affine.copy()
    affine[:3, 3] -= before * affine[:3, 2]
    columns, rows, count = stack.grid.shape
    return replace(stack, grid=Grid((columns, rows, before + count + behind), affine), places=stack.places + before)


def grid_at(planes: Sequence[FramePlane], places: Int[np.ndarray, "n"], step: float, columns: int, rows: int) -> Grid:
    """Voxel grid (RAS) through planes whose places along its last axis and whose step (mm) are known."""
    first = planes[int(np.argmin(places))]
    affine = np.eye(4)
    affine[:3, 0] = first.row * first.spacing[0]
    affine[:3, 1] = first.column * first.spacing[1]
    affine[:3, 2] = first.normal * step
    affine[:3, 3] = first.origin
    return Grid((columns, rows, int(places.max()) + 1), LPS_TO_RAS @ affine)


def stack_at_home(
    planes: Sequence[FramePlane], columns: int, rows: int, home: Grid | None, most_voxels: float
) -> DrawnStack | None:
    """Drawn planes in register as planes of the images; None where they are not all theirs.

    The images may lie off their places, and the planes off theirs, each by `REGULAR_SHARE`.

    Args:
        most_voxels: see `on_images`.
    """
    if home is None or home.shape[:2] != (columns, rows):
        return None
    across = grid_at(planes[:1], np.zeros(1, int), 1.0, columns, rows).affine[:3, :2]
    index = home.to_index(np.array([plane.origin for plane in planes]) @ LPS_TO_RAS[:3, :3])
    turned = np.abs(home.affine[:3, :2] - across).max() / home.spacing[:2].min()
    apart = np.abs(index - np.rint(index)).max()
    within = index[:, 2].min() > -0.5 and index[:, 2].max() < home.shape[2] - 0.5
    if max(turned, apart, np.abs(index[:, :2]).max()) > 2 * REGULAR_SHARE or not within:
        return None
    return on_images(home, np.rint(index[:, 2]).astype(int), most_voxels)


def on_images(home: Grid, places: Int[np.ndarray, "n"], most_voxels: float) -> DrawnStack:
    """Planes drawn on images, on the grid of all of these; of the first to the last drawn one where that is too large.

    Args:
        places: indices along the last axis of the images' grid.
        most_voxels: of a grid of all images.
    """
    numbers = np.arange(len(places))
    if np.prod([float(n) for n in home.shape]) <= most_voxels:
        return DrawnStack(home, numbers, places)
    first, last = int(places.min()), int(places.max())
    return DrawnStack(slab(home, first, last), numbers, places - first)
