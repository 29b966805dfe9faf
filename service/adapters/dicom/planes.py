"""Planes of image frames and how they lie together: from LPS to voxel grids in RAS (PS3.3, C.7.6.2, C.7.6.16).

Pixels are counted along a row first: index axes are column, row and plane, as in the voxel grids of
`model.geometry`.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from pydicom import Dataset

from model.errors import InvalidGeometry, TooLarge
from model.geometry import Grid, slab
from service.adapters.dicom.objects import tolerant
from service.adapters.image_guard import LPS_TO_RAS

#: Directions whose cosines differ by less than this are parallel (about 0.06 degrees).
PARALLEL = 1e-3
#: Share of a pixel or of the step by which planes may lie off their place in a stack, as rounded positions do.
REGULAR_SHARE = 0.05
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
#: Directions and places of which the planes of a drawing may be, at most.
MOST_GROUPS = 512

#: Whether each of some numbered things is like one of them.
Alike = Callable[[int, Int[np.ndarray, "n"]], Bool[np.ndarray, "n"]]


@dataclass(frozen=True)
class ImageGrid(Grid):
    """The voxel grid of images (RAS) and the frame of reference that its world is; empty when the images name none."""

    frame_of_reference: str = ""


@dataclass(frozen=True)
class FramePlane:
    """Where one frame lies, in patient coordinates (LPS mm).

    Attributes:
        origin: centre of the first pixel.
        row, column: unit vectors along a row (towards the next column) and along a column.
        spacing: between columns and between rows (mm).
        depth: nominal distance to the next plane (mm), NaN when unknown.
    """

    origin: Float[np.ndarray, "3"]
    row: Float[np.ndarray, "3"]
    column: Float[np.ndarray, "3"]
    spacing: tuple[float, float]
    depth: float

    @property
    def normal(self) -> Float[np.ndarray, "3"]:
        """Unit vector across the plane."""
        return np.asarray(np.cross(self.row, self.column))

    def offset(self, other: "FramePlane") -> Float[np.ndarray, "3"]:
        """Origin of another frame along row, column and normal of this one (mm)."""
        return np.asarray(np.stack([self.row, self.column, self.normal]) @ (other.origin - self.origin))


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


def frame_planes(found: Dataset, part: str) -> list[FramePlane]:
    """The plane of each frame, of single-frame images and of multi-frame functional groups.

    Raises:
        UnreadableImage: damaged.
        InvalidGeometry: a frame without a plane in the patient's coordinates, as of a volume with coordinates of its
            own, or with directions or spacings that no plane has.
    """
    with tolerant(part):
        if "PerFrameFunctionalGroupsSequence" not in found:
            return [_plane(found, found, found, part)]
        shared = (found.get("SharedFunctionalGroupsSequence") or [Dataset()])[0]
        return [_plane(*_macros(groups, shared), part) for groups in found.PerFrameFunctionalGroupsSequence]


def _macros(frame: Dataset, shared: Dataset) -> tuple[Dataset, Dataset, Dataset]:
    """Position, orientation and pixel measures of a frame, of its own or shared; empty where there are none."""
    names = ("PlanePositionSequence", "PlaneOrientationSequence", "PixelMeasuresSequence")
    position, orientation, measures = (
        ((frame if name in frame else shared).get(name) or [Dataset()])[0] for name in names
    )
    return position, orientation, measures


def _plane(position: Dataset, orientation: Dataset, measures: Dataset, part: str) -> FramePlane:
    needed = (
        (position, "ImagePositionPatient"),
        (orientation, "ImageOrientationPatient"),
        (measures, "PixelSpacing"),
    )
    if not all(holder.get(name) for holder, name in needed):
        raise InvalidGeometry(
            f"{part} has a frame without a plane in the patient's coordinates; frames with Image Position (Patient), "
            "Image Orientation (Patient) and Pixel Spacing are accepted",
            part=part,
        )
    origin = np.array(position.ImagePositionPatient, float)
    row, column = np.array(orientation.ImageOrientationPatient, float).reshape(2, 3)
    between_rows, between_columns = map(float, measures.PixelSpacing)
    depth = float(measures.get("SpacingBetweenSlices") or measures.get("SliceThickness") or np.nan)
    finite = np.isfinite([*origin, *row, *column, between_rows, between_columns]).all()
    if not finite or min(between_rows, between_columns) <= 0 or not _orthonormal(row, column):
        raise InvalidGeometry(
            f"{part} has a frame whose directions or spacing are not those of a plane; "
            "perpendicular unit vectors and positive spacings are accepted",
            part=part,
        )
    return FramePlane(origin, row, column, (between_columns, between_rows), abs(depth))


def _orthonormal(row: Float[np.ndarray, "3"], column: Float[np.ndarray, "3"]) -> bool:
    gram = np.array([row @ row, column @ column, row @ column])
    return bool(np.abs(gram - [1.0, 1.0, 0.0]).max() < PARALLEL)


def parallel_groups(planes: Sequence[FramePlane], part: str) -> list[list[int]]:
    """Numbers of the planes that can be one stack: parallel, of one spacing, in register.

    Raises:
        TooLarge: more than `MOST_GROUPS` stacks.
    """
    axes = np.array([[plane.row, plane.column] for plane in planes])
    spacings, origins = np.array([plane.spacing for plane in planes]), np.array([plane.origin for plane in planes])

    def alike(first: int, others: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
        turned = np.abs(axes[others] - axes[first]).max(axis=(1, 2)) <= PARALLEL
        scaled = np.isclose(spacings[first], spacings[others], rtol=1e-3).all(axis=1)
        shift = np.abs((origins[others] - origins[first]) @ axes[first].T) / spacings[first]
        return np.asarray(turned & scaled & (shift.max(axis=1) <= REGULAR_SHARE))

    return in_groups(len(planes), alike, part)


def in_groups(count: int, alike: Alike, part: str) -> list[list[int]]:
    """Numbers from 0 on, each in the first group whose first number it is like.

    Raises:
        TooLarge: more than `MOST_GROUPS` groups.
    """
    groups: list[list[int]] = []
    rest = np.arange(count)
    while len(rest):
        if len(groups) == MOST_GROUPS:
            raise TooLarge(
                f"{part} draws on planes of more than {MOST_GROUPS} directions or places, the most that are accepted; "
                "planes of few stacks are",
                part=part,
            )
        same = alike(int(rest[0]), rest)
        same[0] = True
        groups.append(rest[same].tolist())
        rest = rest[~same]
    return groups


def _alike(first: FramePlane, second: FramePlane) -> bool:
    turned = max(np.abs(first.row - second.row).max(), np.abs(first.column - second.column).max())
    return bool(turned <= PARALLEL) and np.allclose(first.spacing, second.spacing, rtol=1e-3)


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
    unlike = [number for number, plane in enumerate(planes, 1) if not _alike(first, plane)]
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
