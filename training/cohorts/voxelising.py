"""What a caller says on how meshes become masks."""

from dataclasses import dataclass
from enum import StrEnum

from model.errors import InvalidParameter


class SpaceName(StrEnum):
    """In which world the coordinates of a mesh are."""

    RAS = "RAS"
    LPS = "LPS"


@dataclass(frozen=True)
class Voxelising:
    """How meshes become masks.

    Attributes:
        spacing_mm: side of a voxel.
        space: of the files' coordinates.
    """

    spacing_mm: float = 1.0
    space: SpaceName = SpaceName.RAS

    def __post_init__(self) -> None:
        if not 0.05 <= self.spacing_mm <= 20.0:
            raise InvalidParameter(f"spacing_mm is {self.spacing_mm:g}; 0.05 to 20 mm is accepted.", part="spacing_mm")
