"""RT structure sets to mask stacks (PS3.3, C.8.8.6): closed planar contours on any planes.

Contours of one region and plane are filled by the even-odd rule, which is what the standard means by
both of its ways to draw holes: a keyhole's channel is run through twice and encloses nothing, and of an
XOR pair (CLOSEDPLANAR_XOR) the inner contour takes away. Nested plain contours are read in the same way,
as nearly all who write them mean it. Several regions are joined. A label is an ROI number.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from pydicom import Dataset
from skimage.draw import polygon2mask

from model.errors import InvalidGeometry, InvalidMask
from model.geometry import Grid
from model.inference.mask_stack import MaskStack
from model.inference.stacks import checked_labels
from service.adapters.dicom.objects import tolerant
from service.adapters.dicom.planes import PARALLEL, FramePlane, stack_grid
from service.adapters.dicom.segmentations import require_room, stacks_of
from service.adapters.image_guard import LPS_TO_RAS, ImageLimits

#: Geometric types that enclose an area.
CLOSED = ("CLOSED_PLANAR", "CLOSEDPLANAR_XOR")
#: Numbers of a contour's data below which it encloses nothing.
SMALLEST_CONTOUR = 9
#: Distance of a contour's points from their common plane that is tolerated (mm).
FLATNESS_MM = 0.1
#: Pixels of planes that no image says: this share of the drawing's extent, within the range (mm).
PIXEL_SHARE, PIXEL_RANGE_MM = 1 / 128, (0.25, 1.0)
#: Free room around a drawing without an image (mm).
MARGIN_MM = 20.0


@dataclass(frozen=True)
class Contour:
    """A closed planar contour, LPS mm: its ROI number, its points and its plane's unit normal."""

    region: int
    points: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "3"]


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
        UnreadableImage, InvalidGeometry: damaged, or contours that are not planar.
        InvalidMask: no closed contour, or no such region.
        TooLarge: over a limit.
    """
    checked_labels(labels)
    contours = closed_contours(found, part, labels)
    sheets = _sheets(contours)
    grids: list[Grid] = []
    volumes, drawn = [], []
    for group in _by_direction(sheets):
        grid, places = _grid_of(group, home)
        require_room([*grids, grid], part, limits)
        volume = np.zeros(grid.shape, bool)
        for place, sheet in zip(places, group, strict=True):
            volume[:, :, place] |= _filled(sheet, grid)
        grids.append(grid)
        volumes.append(volume)
        drawn.append(np.unique(places))
    return stacks_of(part, grids, volumes, drawn)


def closed_contours(found: Dataset, part: str, labels: frozenset[int] | None) -> list[Contour]:
    """The closed planar contours of the chosen regions."""
    with tolerant(part):
        regions = {int(r.ReferencedROINumber): r.get("ContourSequence") or [] for r in found.ROIContourSequence}
        if labels is not None and labels.isdisjoint(regions):
            listed = ", ".join(map(str, sorted(regions)[:12])) or "none"
            raise InvalidMask(f"{part} has no such region; regions that are there: {listed}", part=part)
        points = [
            (number, np.array(item.ContourData, float).reshape(-1, 3))
            for number, items in regions.items()
            for item in items
            if (labels is None or number in labels)
            and item.ContourGeometricType in CLOSED
            and len(item.ContourData) >= SMALLEST_CONTOUR
        ]
    if not points:
        raise InvalidMask(f"{part} holds no closed planar contour of the region; one or more are needed", part=part)
    return [_flat(region, contour, part) for region, contour in points]


def _flat(region: int, points: Float[np.ndarray, "n 3"], part: str) -> Contour:
    """A contour with its normal (Newell), turned so that its largest component is positive."""
    following = np.roll(points, -1, axis=0)
    middle = points.mean(axis=0)
    area = np.cross(points - middle, following - middle).sum(axis=0)
    length = np.linalg.norm(area)
    normal = area / length if length > 0 else np.full(3, np.nan)
    if not np.isfinite(points).all() or not np.abs((points - middle) @ normal).max() <= FLATNESS_MM:
        raise InvalidGeometry(f"{part} has a contour that does not lie in a plane; planar ones are accepted", part=part)
    return Contour(region, points, normal * np.sign(normal[np.argmax(np.abs(normal))]))


def _sheets(contours: Sequence[Contour]) -> list[list[Contour]]:
    """Contours by the plane they lie in."""
    sheets: list[list[Contour]] = []
    for contour in contours:
        home = next((sheet for sheet in sheets if _same_plane(sheet[0], contour)), None)
        if home is None:
            sheets.append([contour])
        else:
            home.append(contour)
    return sheets


def _parallel(first: Contour, second: Contour) -> bool:
    return bool(np.linalg.norm(np.cross(first.normal, second.normal)) <= 10 * PARALLEL)


def _same_plane(first: Contour, second: Contour) -> bool:
    apart = abs(first.normal @ (second.points.mean(axis=0) - first.points.mean(axis=0)))
    return _parallel(first, second) and bool(apart <= FLATNESS_MM)


def _by_direction(sheets: Sequence[list[Contour]]) -> list[list[list[Contour]]]:
    groups: list[list[list[Contour]]] = []
    for sheet in sheets:
        home = next((group for group in groups if _parallel(group[0][0], sheet[0])), None)
        if home is None:
            groups.append([sheet])
        else:
            home.append(sheet)
    return groups


def _grid_of(group: Sequence[list[Contour]], home: Grid | None) -> tuple[Grid, list[int]]:
    """A grid through the planes of a group: the images' where the planes are theirs."""
    if home is not None and np.linalg.norm(np.cross(home.directions[:, 2], _ras(group[0][0].normal))) < 10 * PARALLEL:
        points = np.array([_ras(sheet[0].points.mean(axis=0)) for sheet in group])
        index = home.to_index(points)[:, 2]
        near = np.abs(index - np.rint(index)).max() * home.spacing[2] <= FLATNESS_MM
        if near and index.min() > -0.5 and index.max() < home.shape[2] - 0.5:
            return home, [round(i) for i in index.tolist()]
    return _own_grid(group)


def _ras(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    return np.asarray(vectors @ LPS_TO_RAS[:3, :3])


def _own_grid(group: Sequence[list[Contour]]) -> tuple[Grid, list[int]]:
    points = np.concatenate([contour.points for sheet in group for contour in sheet])
    row, column = _axes(group[0][0].normal)
    along = points @ np.stack([row, column]).T
    low, high = along.min(axis=0) - MARGIN_MM, along.max(axis=0) + MARGIN_MM
    pixel = float(np.clip((high - low).max() * PIXEL_SHARE, *PIXEL_RANGE_MM))
    columns, rows = (int(n) for n in np.ceil((high - low) / pixel) + 1)
    normal = np.cross(row, column)
    corner = low[0] * row + low[1] * column
    planes = [
        FramePlane(corner + normal * (sheet[0].points @ normal).mean(), row, column, (pixel, pixel), np.nan)
        for sheet in group
    ]
    grid, places = stack_grid(planes, columns, rows)
    return _with_room(grid, [int(place) for place in places])


def _with_room(grid: Grid, places: list[int]) -> tuple[Grid, list[int]]:
    """The grid with room before its first and behind its last plane."""
    more = int(np.ceil(MARGIN_MM / grid.spacing[2]))
    affine = grid.affine.copy()
    affine[:3, 3] -= more * affine[:3, 2]
    columns, rows, count = grid.shape
    return Grid((columns, rows, count + 2 * more), affine), [place + more for place in places]


def _axes(normal: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Row and column directions of a plane, as near to the patient's axes as can be."""
    nearest = np.eye(3)[int(np.argmin(np.abs(normal)))]
    row = nearest - (nearest @ normal) * normal
    row /= np.linalg.norm(row)
    return row, np.asarray(np.cross(normal, row))


def _filled(sheet: Sequence[Contour], grid: Grid) -> Bool[np.ndarray, "i j"]:
    """Pixels whose centres the contours of one plane enclose: even-odd within a region, any of the regions."""
    inside = {contour.region: np.zeros(grid.shape[:2], bool) for contour in sheet}
    for contour in sheet:
        index = grid.to_index(_ras(contour.points))[:, :2]
        inside[contour.region] ^= polygon2mask(grid.shape[:2], index)  # type: ignore[no-untyped-call]
    return np.asarray(np.any(list(inside.values()), axis=0))
