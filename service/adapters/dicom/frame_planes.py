"""Where the frames of images lie, in patient coordinates (PS3.3, C.7.6.2, C.7.6.16)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from pydicom import Dataset

from model.errors import InvalidGeometry
from service.adapters.dicom.objects import tolerant

#: Directions whose cosines differ by less than this are parallel (about 0.06 degrees).
PARALLEL = 1e-3


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
