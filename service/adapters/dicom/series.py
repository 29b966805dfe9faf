"""The images that a drawing refers to: their order, their common grid, their instances (PS3.3, C.7.6.2)."""

from collections.abc import Sequence
from dataclasses import dataclass

from pydicom import Dataset

from model.errors import InvalidGeometry
from model.geometry import Grid
from service.adapters.dicom.objects import quiet
from service.adapters.dicom.planes import FramePlane, frame_planes, parallel_groups, stack_grid

#: Elements of patient and study that every image has to have, if without a value (type 2; PS3.3, C.7.1.1 and C.7.2.1).
COMMON = (
    *("PatientName", "PatientID", "PatientBirthDate", "PatientSex"),
    *("AccessionNumber", "StudyID", "StudyDate", "StudyTime", "ReferringPhysicianName"),
)


@dataclass(frozen=True)
class Series:
    """Images of one series in the order of their planes.

    Attributes:
        images: data sets without pixels, single-frame and in order, or one multi-frame.
        planes: of each frame, in the order of the images and their frames.
        grid: of all frames (RAS); index axes are column, row and frame.
        order: index along the grid's last axis of each frame.
    """

    images: tuple[Dataset, ...]
    planes: tuple[FramePlane, ...]
    grid: Grid
    order: tuple[int, ...]


def series_of(images: Sequence[Dataset], part: str = "series") -> Series:
    """Order the images of a series and find their grid.

    Raises:
        InvalidGeometry: no image, frames that are not parallel, several at one place, or gaps between them.
        UnreadableImage: an image without a plane.
    """
    if not images:
        raise InvalidGeometry(f"The {part} has no images; those that were drawn on are needed", part=part)
    found = [(completed(image), frame_planes(image, part)) for image in images]
    first = found[0][1][0]
    found.sort(key=lambda item: float(first.offset(item[1][0])[2]))
    planes = [plane for _, own in found for plane in own]
    grid, places = stack_grid(planes, int(images[0].Columns), int(images[0].Rows))
    if len(parallel_groups(planes)) > 1 or sorted(places) != list(range(len(planes))):
        raise InvalidGeometry(
            f"The {part} is no regular stack of planes; parallel ones at equal distances are accepted", part=part
        )
    return Series(tuple(image for image, _ in found), tuple(planes), grid, tuple(int(place) for place in places))


def completed(image: Dataset) -> Dataset:
    """The image with every element that those derived from it must carry over, empty where it has none."""
    with quiet():
        for name in COMMON:
            if name not in image:
                setattr(image, name, None)
    return image
