"""RT structure sets to mask stacks (PS3.3, C.8.8.6): closed planar contours on any planes.

What the contours of a plane enclose: `service.adapters.dicom.contour_filling`. Several regions are joined. A label is
an ROI number. Points, open contours, those of fewer than three points and those without an area (points on a line,
halves that cancel each other) are passed over, as are regions without another contour.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from pydicom import Dataset

from model.geometry import Grid
from model.inference.mask_stack import MaskStack
from service.adapters.dicom.contour_filling import filled
from service.adapters.dicom.contours import FLATNESS_MM, Contour, closed_contours, ras
from service.adapters.dicom.frame_planes import PARALLEL, FramePlane
from service.adapters.dicom.plane_groups import REGULAR_SHARE, in_groups
from service.adapters.dicom.planes import DrawnStack, drawn_stacks, on_images
from service.adapters.dicom.segmentations import require_room, stacks_of
from service.adapters.image_guard import ImageLimits

#: Pixels of planes that no image says: this share of the drawing's extent, within the range (mm).
PIXEL_SHARE, PIXEL_RANGE_MM = 1 / 128, (0.25, 1.0)
#: Free room around a drawing without an image (mm).
MARGIN_MM = 20.0


def read_structure_set(
    found: Dataset,
    part: str,
    limits: ImageLimits,
    labels: frozenset[int] | None = None,
    home: Grid | None = None,
) -> tuple[MaskStack, ...]:
    """The stacks of the object that the contours draw.

    Args:
        labels: ROI numbers of the object; all of them when None.
        home: grid of the images that were drawn on; contours on their planes are drawn on its pixels.

    Raises:
        UnreadableImage, InvalidGeometry: damaged, or contours that are not planar or lie beside the images.
        InvalidMask: no closed contour with an area, or a region that the object does not have.
        TooLarge: over a limit.
    """
    groups = _by_direction(closed_contours(found, part, labels), part)
    grids: list[Grid] = []
    volumes, drawn = [], []
    for group in groups:
        sheets = _sheets(group)
        stacks = _stacks_of_sheets(sheets, group[0].normal, home, limits.max_voxels / len(groups))
        grids += [stack.grid for stack in stacks]
        require_room(grids, part, limits)
        volumes += [_painted(stack, sheets, part) for stack in stacks]
        drawn += [np.unique(stack.places) for stack in stacks]
    return stacks_of(part, grids, volumes, drawn)


def _painted(stack: DrawnStack, sheets: Sequence[list[Contour]], part: str) -> Bool[np.ndarray, "i j k"]:
    """What the contours of the planes on a stack enclose."""
    volume = np.zeros(stack.grid.shape, bool)
    for number, place in zip(stack.numbers.tolist(), stack.places.tolist(), strict=True):
        volume[:, :, place] |= filled(sheets[number], stack.grid, part)
    return volume


def _by_direction(contours: Sequence[Contour], part: str) -> list[list[Contour]]:
    """Contours whose planes are parallel; the largest, whose normal is surest, stays the first of each."""
    normals = np.array([contour.normal for contour in contours])

    def parallel(first: int, others: Int[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
        return np.asarray(np.linalg.norm(np.cross(normals[first], normals[others]), axis=1) <= 10 * PARALLEL)

    return [[contours[number] for number in group] for group in in_groups(len(contours), parallel, part)]


def _sheets(group: Sequence[Contour]) -> list[list[Contour]]:
    """Parallel contours by the plane they lie in, from the lowest to the highest.

    Each may lie off its plane by `FLATNESS_MM`. Where the planes are far apart, so may two of one plane.
    """
    heights = np.array([group[0].normal @ contour.middle for contour in group])
    order = np.argsort(heights, kind="stable")
    gaps = np.diff(heights[order])
    usual = np.median(gaps[gaps > FLATNESS_MM]) if (gaps > FLATNESS_MM).any() else 0.0
    apart = min(max(FLATNESS_MM, REGULAR_SHARE * usual), 2 * FLATNESS_MM)
    sheets: list[list[int]] = [[]]
    for number in order.tolist():
        if sheets[-1] and heights[number] - heights[sheets[-1][0]] > apart:
            sheets.append([])
        sheets[-1].append(number)
    return [[group[number] for number in sorted(sheet)] for sheet in sheets]


def _stacks_of_sheets(
    sheets: Sequence[list[Contour]], normal: Float[np.ndarray, "3"], home: Grid | None, most_voxels: float
) -> list[DrawnStack]:
    """Stacks that hold each plane of a direction: the images' grid where the planes are theirs."""
    if home is not None and np.linalg.norm(np.cross(home.directions[:, 2], ras(normal))) < 10 * PARALLEL:
        index = home.to_index(np.array([ras(sheet[0].middle) for sheet in sheets]))[:, 2]
        near = np.abs(index - np.rint(index)).max() <= max(FLATNESS_MM / home.spacing[2], REGULAR_SHARE)
        if near and index.min() > -0.5 and index.max() < home.shape[2] - 0.5:
            return [on_images(home, np.rint(index).astype(int), most_voxels)]
    return _own_stacks(sheets, normal, most_voxels)


def _own_stacks(
    sheets: Sequence[list[Contour]], across: Float[np.ndarray, "3"], most_voxels: float
) -> list[DrawnStack]:
    """Stacks on pixels that suit the drawing, with room around it."""
    points = np.concatenate([contour.points for sheet in sheets for contour in sheet])
    row, column = _axes(across)
    along = points @ np.stack([row, column]).T
    low, high = along.min(axis=0) - MARGIN_MM, along.max(axis=0) + MARGIN_MM
    pixel = float(np.clip((high - low).max() * PIXEL_SHARE, *PIXEL_RANGE_MM))
    columns, rows = (int(n) for n in np.ceil((high - low) / pixel) + 1)
    normal = np.cross(row, column)
    corner = low[0] * row + low[1] * column
    planes = [
        FramePlane(corner + normal * (sheet[0].points @ normal).mean(), row, column, (pixel, pixel), np.nan)
        for sheet in sheets
    ]
    return drawn_stacks(planes, columns, rows, most_voxels, MARGIN_MM)


def _axes(normal: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Row and column directions of a plane, as near to the patient's axes as can be."""
    nearest = np.eye(3)[int(np.argmin(np.abs(normal)))]
    row = nearest - (nearest @ normal) * normal
    row /= np.linalg.norm(row)
    return row, np.asarray(np.cross(normal, row))
