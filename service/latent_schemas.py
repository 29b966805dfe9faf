"""Wire types of latent codes: features of a reconstruction, and the way between two of them."""

from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from service.ports import MeshFormat
from service.request_schemas import SpacingMm
from service.schemas import ModelReference

#: Surfaces on the way between two reconstructions, at most.
MOST_STEPS = 64


class InterpolationQuery(BaseModel):
    """Query of the way between two reconstructions."""

    model_config = ConfigDict(extra="forbid")

    other: Annotated[str, AfterValidator(str.lower)] = Field(
        alias="with", description="identifier of the other result, of the same model"
    )
    at: Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)] | None = Field(
        None, description="0 is the first shape, 1 the other; 0.5 when left out"
    )
    steps: Annotated[int, Field(ge=2, le=MOST_STEPS)] | None = Field(
        None, description="as many surfaces from the first shape to the other, both among them, as a ZIP; not with at"
    )
    format: MeshFormat = Field(MeshFormat.PLY, description="file format")
    spacing_mm: SpacingMm | None = Field(None, description="grid step (mm); the model's when left out")


class Features(BaseModel):
    """The latent code of a reconstruction, for downstream analysis; all lists are over the latent dimensions."""

    model: ModelReference
    latent: list[float] = Field(description="the code z")
    posterior_sd: list[float] | None = Field(
        description="standard deviation of each entry given the drawing; null without uncertainty by Laplace"
    )
    base: list[float] = Field(description="g(z) over sigma: standard normal over the prior")
    population_mean: list[float] = Field(description="mean of the training codes")
    population_sd: list[float] = Field(description="standard deviation of the training codes")
    active: list[bool] = Field(description="among the dimensions that explain 99 % of the surface's variance")
    log_prior_density_nats: float
    typicality_percentile: float = Field(description="share of the training population with a lower density, 0 to 100")
