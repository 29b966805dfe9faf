"""Planes of image frames and how they lie together: from LPS to voxel grids in RAS (PS3.3, C.7.6.2, C.7.6.16).

Pixels are counted along a row first: index axes are column, row and plane, as in the voxel grids of
`model.geometry`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from pydicom import Dataset

from model.errors import InvalidGeometry
from model.geometry import Grid
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
#: Steps tried for irregular planes: their smallest distance through 1, 2, ... so many.
FINEST_PART = 16
#: No step below this is tried (mm), unless planes are nearer to each other: they are rounded by half of it at most.
FINEST_MM = 0.1
#: Planes named in a message, at most.
LISTED_PLANES = 4


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


def frame_planes(found: Dataset, part: str) -> list[FramePlane]:
    """The plane of each frame, of single-frame images and of multi-frame functional groups.

    Raises:
        UnreadableImage: an object without planes.
        InvalidGeometry: directions or spacings that no plane has.
    """
    with tolerant(part):
        if "PerFrameFunctionalGroupsSequence" not in found:
            return [_plane(found, found, found, part)]
        shared = found.get("SharedFunctionalGroupsSequence") or [Dataset()]
        return [_plane_of_groups(groups, shared[0], part) for groups in found.PerFrameFunctionalGroupsSequence]


def _plane_of_groups(frame: Dataset, shared: Dataset, part: str) -> FramePlane:
    names = ("PlanePositionSequence", "PlaneOrientationSequence", "PixelMeasuresSequence")
    position, orientation, measures = ((frame if name in frame else shared)[name][0] for name in names)
    return _plane(position, orientation, measures, part)


def _plane(position: Dataset, orientation: Dataset, measures: Dataset, part: str) -> FramePlane:
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


def parallel_groups(planes: Sequence[FramePlane]) -> list[list[int]]:
    """Numbers of the planes that can be one stack: parallel, of one spacing, in register."""
    groups: list[list[int]] = []
    for number, plane in enumerate(planes):
        home = next((group for group in groups if _in_register(planes[group[0]], plane)), None)
        if home is None:
            groups.append([number])
        else:
            home.append(number)
    return groups


def _in_register(first: FramePlane, second: FramePlane) -> bool:
    shift = np.abs(first.offset(second)[:2]) / first.spacing
    return _alike(first, second) and bool(shift.max() <= REGULAR_SHARE)


def _alike(first: FramePlane, second: FramePlane) -> bool:
    turned = max(np.abs(first.row - second.row).max(), np.abs(first.column - second.column).max())
    return bool(turned <= PARALLEL) and np.allclose(first.spacing, second.spacing, rtol=1e-3)


def stack_places(planes: Sequence[FramePlane]) -> tuple[Int[np.ndarray, "n"], float]:
    """Place of each plane of a sparse drawing in a regular stack from 0 on, and the stack's step (mm).

    Tried are the planes' nominal distance and parts of their smallest one. Each is fitted to the planes, so that
    rounded positions do not add up.
    """
    heights = np.array([planes[0].offset(plane)[2] for plane in planes])
    up, depth = heights - heights.min(), _depth(planes)
    distances, near = np.diff(np.unique(up)), min(REGULAR_MM, depth / 2)
    smallest = float(distances.min(initial=np.inf, where=distances > near))
    if not np.isfinite(smallest):
        return np.zeros(len(planes), int), depth
    parts = [smallest / count for count in range(1, FINEST_PART + 1)]
    tried = [(depth, NOMINAL_SHARE), *((part, REGULAR_SHARE) for part in parts)]
    tried = [(step, share) for step, share in tried if step >= min(smallest, FINEST_MM)]
    for step, share in tried:
        places, fitted = _fitted(up, step)
        if abs(fitted - step) <= share * step and np.abs(up - places * fitted).max() <= near:
            return places, fitted
    finest = tried[-1][0]
    return np.rint(up / finest).astype(int), finest


def _fitted(up: Float[np.ndarray, "n"], step: float) -> tuple[Int[np.ndarray, "n"], float]:
    """Places by the distance from each plane to the next one, and the step that takes the last plane to its place."""
    order = np.argsort(up)
    places = np.zeros(len(up), int)
    places[order] = np.cumsum(np.rint(np.diff(up[order], prepend=0.0) / step)).astype(int)
    return places, float(up.max() / places.max()) if places.max() else step


def _depth(planes: Sequence[FramePlane]) -> float:
    """Nominal distance between planes (mm); their finer pixel spacing when none says it."""
    return next((p.depth for p in planes if np.isfinite(p.depth) and p.depth > 0), min(planes[0].spacing))


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


def stack_grid(planes: Sequence[FramePlane], columns: int, rows: int) -> tuple[Grid, Int[np.ndarray, "n"]]:
    """Voxel grid (RAS) around parallel drawn planes in register, and each plane's index along its last axis."""
    places, step = stack_places(planes)
    return grid_at(planes, places, step, columns, rows), places


def grid_at(planes: Sequence[FramePlane], places: Int[np.ndarray, "n"], step: float, columns: int, rows: int) -> Grid:
    """Voxel grid (RAS) through planes whose places along its last axis and whose step (mm) are known."""
    first = planes[int(np.argmin(places))]
    affine = np.eye(4)
    affine[:3, 0] = first.row * first.spacing[0]
    affine[:3, 1] = first.column * first.spacing[1]
    affine[:3, 2] = first.normal * step
    affine[:3, 3] = first.origin
    return Grid((columns, rows, int(places.max()) + 1), LPS_TO_RAS @ affine)


def at_home(grid: Grid, places: Int[np.ndarray, "n"], home: Grid | None) -> tuple[Grid, Int[np.ndarray, "n"]]:
    """The images' grid and the planes' indices in it, where they are planes of the images; else both as they are.

    The images may lie off their places, and the planes off theirs, each by `REGULAR_SHARE`.
    """
    if home is None or home.shape[:2] != grid.shape[:2]:
        return grid, places
    planes = grid.to_world(np.array([[0.0, 0.0, place] for place in places]))
    index = home.to_index(planes)
    turned = np.abs(home.affine[:3, :2] - grid.affine[:3, :2]).max() / home.spacing[:2].min()
    apart = np.abs(index - np.rint(index)).max()
    within = index[:, 2].min() > -0.5 and index[:, 2].max() < home.shape[2] - 0.5
    if max(turned, apart, np.abs(index[:, :2]).max()) > 2 * REGULAR_SHARE or not within:
        return grid, places
    return home, np.rint(index[:, 2]).astype(int)
