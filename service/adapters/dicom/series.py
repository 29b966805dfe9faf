"""The images that a drawing refers to: their order, their common grid, their instances (PS3.3, C.7.6.2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydicom import Dataset

from model.errors import InvalidGeometry
from model.geometry import slab
from model.inference.mesh import Mesh
from model.inference.reconstruction import SURFACE_SD
from service.adapters.dicom.frame_planes import FramePlane, frame_planes
from service.adapters.dicom.headers import completed
from service.adapters.dicom.objects import tolerant
from service.adapters.dicom.planes import ImageGrid, complete_places, grid_at

#: Images farther from the surface than this hold nothing of the object: in mm, and in SDs of the surface on top.
MARGIN_MM, MARGIN_SDS = 2.0, 4.0


@dataclass(frozen=True)
class Series:
    """Images of one series in the order of their planes.

    Attributes:
        images: headers as `completed` makes them, single-frame and in order, or one multi-frame.
        planes: of each frame, in the order of the images and their frames.
        grid: of all frames (RAS), in the images' frame of reference; index axes are column, row and frame.
        order: index along the grid's last axis of each frame.
    """

    images: tuple[Dataset, ...]
    planes: tuple[FramePlane, ...]
    grid: ImageGrid
    order: tuple[int, ...]


def around(series: Series, mesh: Mesh) -> Series:
    """The images that a surface comes near, which results are given back on; one of many frames stays whole.

    Args:
        mesh: the surface (world RAS mm), with its SD where that is known.
    """
    if len(series.images) < len(series.planes):
        return series
    sd_mm = float(np.max(mesh.scalars.get(SURFACE_SD, 0.0)))
    places = series.grid.to_index(mesh.vertices)[:, 2]
    reach = (MARGIN_MM + MARGIN_SDS * sd_mm) / series.grid.spacing[2]
    ends = np.array([places.min() - reach, places.max() + reach])
    first, last = np.clip(np.rint(ends), 0, series.grid.shape[2] - 1).astype(int).tolist()
    kept = [number for number, place in enumerate(series.order) if first <= place <= last]
    return Series(
        tuple(series.images[number] for number in kept),
        tuple(series.planes[number] for number in kept),
        slab(series.grid, first, last),
        tuple(series.order[number] - first for number in kept),
    )


def series_of(images: Sequence[Dataset], part: str = "series") -> Series:
    """Order the images of a series and find their grid.

    Raises:
        InvalidGeometry: no image, several of many frames, frames in several directions, shifted against each
            other, several at one place, or gaps between them.
        UnreadableImage: an image without a plane.
        InputError: a header that results cannot be made from.
    """
    if not images:
        raise InvalidGeometry(f"The {part} has no images; those that were drawn on are needed", part=part)
    if len(images) > 1 and any("PerFrameFunctionalGroupsSequence" in image for image in images):
        raise InvalidGeometry(
            f"The {part} has {len(images)} images, multi-frame ones among them; "
            "single-frame images, or one multi-frame image, are accepted",
            part=part,
        )
    found = [(image, frame_planes(image, part)) for image in images]
    first = found[0][1][0]
    found.sort(key=lambda item: float(first.offset(item[1][0])[2]))
    planes = [plane for _, own in found for plane in own]
    places, step = complete_places(planes, part)
    with tolerant(part):
        columns, rows = int(images[0].Columns), int(images[0].Rows)
    grid = grid_at(planes, places, step, columns, rows)
    ordered = completed([image for image, _ in found], grid, part)
    named = ImageGrid(grid.shape, grid.affine, str(ordered[0].get("FrameOfReferenceUID") or ""))
    return Series(ordered, tuple(planes), named, tuple(int(place) for place in places))
