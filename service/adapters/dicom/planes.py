"""Planes of image frames and how they lie together: from LPS to voxel grids in RAS (PS3.3, C.7.6.2, C.7.6.16).

Pixels are counted along a row first: index axes are column, row and plane, as in the voxel grids of
`model.geometry`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from pydicom import Dataset

from model.errors import InvalidGeometry
from model.geometry import Grid
from service.adapters.dicom.objects import tolerant
from service.adapters.image_guard import LPS_TO_RAS

#: Directions whose cosines differ by less than this are parallel (about 0.06 degrees).
PARALLEL = 1e-3
#: Shares of a pixel by which parallel frames may be shifted in their plane and still form one stack.
SHIFT_TOLERANCE = 0.01
#: Distance of a plane from its place in a regular stack that is rounded away (mm).
REGULAR_MM = 0.02
#: Steps tried for irregular planes: their smallest distance through 1, 2, ... so many.
FINEST_PART = 16


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
    turned = max(np.abs(first.row - second.row).max(), np.abs(first.column - second.column).max())
    if turned > PARALLEL or not np.allclose(first.spacing, second.spacing, rtol=1e-3):
        return False
    shift = np.abs(first.offset(second)[:2]) / first.spacing
    return bool(shift.max() <= SHIFT_TOLERANCE)


def stack_places(planes: Sequence[FramePlane]) -> tuple[Int[np.ndarray, "n"], float]:
    """Place of each parallel plane in a regular stack from 0 on, and the stack's step (mm)."""
    heights = np.array([planes[0].offset(plane)[2] for plane in planes])
    distances = np.diff(np.unique(np.round(heights, 4)))
    depth = next((p.depth for p in planes if np.isfinite(p.depth) and p.depth > 0), min(planes[0].spacing))
    smallest = float(distances.min(initial=np.inf))
    parts = [smallest / count for count in range(1, FINEST_PART + 1)] if np.isfinite(smallest) else []
    up = heights - heights.min()
    step = next((s for s in (depth, *parts) if _regular(up, s)), parts[-1] if parts else depth)
    return np.rint(up / step).astype(int), step


def _regular(heights: Float[np.ndarray, "n"], step: float) -> bool:
    return bool(np.abs(heights - np.rint(heights / step) * step).max() <= REGULAR_MM)


def stack_grid(planes: Sequence[FramePlane], columns: int, rows: int) -> tuple[Grid, Int[np.ndarray, "n"]]:
    """Voxel grid (RAS) around parallel planes in register, and each plane's index along its last axis."""
    places, step = stack_places(planes)
    first = planes[int(np.argmin(places))]
    affine = np.eye(4)
    affine[:3, 0] = first.row * first.spacing[0]
    affine[:3, 1] = first.column * first.spacing[1]
    affine[:3, 2] = first.normal * step
    affine[:3, 3] = first.origin
    return Grid((columns, rows, int(places.max()) + 1), LPS_TO_RAS @ affine), places


def at_home(grid: Grid, places: Int[np.ndarray, "n"], home: Grid | None) -> tuple[Grid, Int[np.ndarray, "n"]]:
    """The images' grid and the planes' indices in it, where they are planes of the images; else both as they are."""
    if home is None or home.shape[:2] != grid.shape[:2]:
        return grid, places
    planes = grid.to_world(np.array([[0.0, 0.0, place] for place in places]))
    index = home.to_index(planes)
    turned = np.abs(home.affine[:3, :2] - grid.affine[:3, :2]).max() / home.spacing[:2].min()
    apart = np.abs(index - np.rint(index)).max()
    within = index[:, 2].min() > -0.5 and index[:, 2].max() < home.shape[2] - 0.5
    if max(turned, apart, np.abs(index[:, :2]).max()) > SHIFT_TOLERANCE or not within:
        return grid, places
    return home, np.rint(index[:, 2]).astype(int)
