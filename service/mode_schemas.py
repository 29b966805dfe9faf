"""Wire types of modes of shape."""

from pydantic import BaseModel, ConfigDict, Field

from model.errors import InvalidParameter
from model.inference.modes import FARTHEST_SD
from service.ports import MeshFormat
from service.request_schemas import SpacingMm
from service.schemas import ModelReference


class ModeMeshQuery(BaseModel):
    """Query of a surface along modes."""

    model_config = ConfigDict(extra="forbid")

    format: MeshFormat = Field(MeshFormat.PLY, description="file format")
    spacing_mm: SpacingMm | None = Field(None, description="grid step (mm); the model's when left out")


class ModeQuery(ModeMeshQuery):
    """Query of a surface along one mode."""

    sd: float = Field(
        2.0,
        ge=-FARTHEST_SD,
        le=FARTHEST_SD,
        allow_inf_nan=False,
        description="how far from the mean along the mode, in standard deviations",
    )


class ShapeQuery(ModeMeshQuery):
    """Query of a surface at coordinates along several modes."""

    mode: list[str] = Field(
        default_factory=list,
        description="RANK:SD, such as 1:-2; repeated or separated by commas. Modes not named stay at 0; the mean shape "
        "when left out",
    )


class ModeSchema(BaseModel):
    """One dimension of the flow's base."""

    rank: int = Field(description="by displacement, from 1")
    dimension: int = Field(description="index in the latent code, from 0")
    sigma: float = Field(description="standard deviation of the base")
    displacement_mm_per_sd: float = Field(
        description="root mean square over the mean surface of its movement by one standard deviation, both ways (mm)"
    )
    variance_explained: float = Field(description="share of the surface's variance, 0 to 1")
    cumulative_variance: float = Field(description="sum of the shares up to this rank")
    link: str = Field(description="the surface along this mode")


class ActiveModes(BaseModel):
    """How many modes, by rank, explain so much of the variance of the surface."""

    percent_95: int
    percent_97: int
    percent_99: int


class ModeList(BaseModel):
    """Modes of a model by rank."""

    model: ModelReference
    active_dimensions: ActiveModes
    modes: list[ModeSchema]


def parse_coordinates(texts: list[str]) -> dict[int, float]:
    """The `mode` parameter: coordinates (SD) by rank.

    Raises:
        InvalidParameter: not of the form RANK:SD, out of range, or a rank twice.
    """
    words = [word.strip() for text in texts for word in text.split(",")]
    found: dict[int, float] = {}
    for word in words:
        rank, separator, sd = word.partition(":")
        if not (separator and rank.isascii() and rank.isdecimal() and len(rank) <= 5 and _is_coordinate(sd)):
            raise InvalidParameter(
                f"The parameter mode must be RANK:SD such as 1:-2, the SD from -{FARTHEST_SD:g} to {FARTHEST_SD:g}.",
                part="mode",
            )
        if int(rank) in found:
            raise InvalidParameter(f"The parameter mode names rank {int(rank)} twice; once is accepted.", part="mode")
        found[int(rank)] = float(sd)
    return found


def _is_coordinate(text: str) -> bool:
    try:
        return abs(float(text)) <= FARTHEST_SD
    except ValueError:
        return False
