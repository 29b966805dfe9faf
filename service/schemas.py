"""Wire types of the HTTP interface's answers; units stand in the names of the fields. They stop at the routes."""

from datetime import datetime
from typing import Annotated, Literal

from pydantic import BaseModel, Field

from model.geometry import Space
from service.request_schemas import PlaneSchema

#: World of an answer's coordinates.
InputSpace = Annotated[
    Space, Field(description="world of the coordinates, the input's own: LPS where all masks were DICOM, RAS otherwise")
]


class StackSchema(BaseModel):
    """The voxels of one mask."""

    part: str = Field(description="the part that it came in")
    shape: list[int] = Field(description="voxels along i, j and k")
    affine: list[list[float]] = Field(description="4 x 4, by rows: voxel index to RAS mm")


class DrawnPlaneSchema(PlaneSchema):
    """An annotated plane and what is drawn on it."""

    runs: list[list[int]] = Field(
        description="foreground as [start, length] in the plane's voxels by rows, in-plane axes in ascending order"
    )


class DrawnPlanes(BaseModel):
    """What a reconstruction reads of masks; coordinates are RAS in mm, of DICOM objects too."""

    space: Literal["RAS"] = "RAS"
    unit: Literal["mm"] = "mm"
    stacks: list[StackSchema]
    planes: list[DrawnPlaneSchema]
    warnings: list[str] = Field(description="what a summary would warn of in the files")


class EstimateSchema(BaseModel):
    """A figure with its 90 % interval; the ends are null without uncertainty."""

    value: float
    low: float | None
    high: float | None


class ExtentSchema(BaseModel):
    """An extent of the surface along a direction."""

    along: str = Field(description="as it was asked for: R, A, S, longest, or three numbers")
    direction: list[float] = Field(description="unit vector in the input's world")
    extent_mm: EstimateSchema


class ModelReference(BaseModel):
    """Which model made a result."""

    name: str
    version: str
    digest: str = Field(description="SHA-256 of the bundle")


class FitSchema(BaseModel):
    """How the fit ended."""

    status: Literal["converged", "stalled", "iteration_limit"]
    converged: bool
    message: str
    iterations: int


class PoseSchema(BaseModel):
    """Where the shape lies in the input's world: canonical = scale * rotation * flip * (world - position)."""

    position_mm: list[float] = Field(description="the model's origin in the world")
    rotation: list[list[float]] = Field(description="3 x 3, by rows")
    scale: float
    mirrored: bool


class ColourLegend(BaseModel):
    """What the vertex colours of a mesh in GLB mean; values between two stops are mixed linearly."""

    scalar: Literal["surface_sd_mm"] = "surface_sd_mm"
    values_mm: list[float] = Field(description="standard deviation (mm) at each stop")
    colours: list[str] = Field(description="sRGB at each stop, as #rrggbb")


class SurfaceSdSummary(BaseModel):
    """Standard deviation of the surface along its normal (mm)."""

    mean_mm: float
    max_mm: float
    legend: ColourLegend


class ResidualSchema(BaseModel):
    """How far a drawn plane and the reconstruction disagree."""

    plane: PlaneSchema
    disagreement: float = Field(description="1 - Dice between the drawing and the reconstruction's section, 0 to 1")
    mean_error: float = Field(description="mean of label minus probability")
    predictive_p: float | None = Field(
        description="how probable it is that a sound drawing disagrees at least as much with its reconstruction; null "
        "for a model that was not calibrated for it"
    )


class Links(BaseModel):
    """Where the parts of a result are."""

    self: str
    mesh: str
    segmentation: str
    occupancy: str
    features: str
    uncertainty: str | None = Field(description="null when uncertainty was not asked for")
    surface_sd: str | None = Field(description="null when uncertainty was not asked for")
    posterior: str | None = Field(description="null when uncertainty was not asked for")
    next_plane: str | None = Field(description="null when uncertainty was not asked for")


class Summary(BaseModel):
    """What a reconstruction found; coordinates are of the input's world in mm."""

    model: ModelReference
    space: InputSpace
    unit: Literal["mm"] = "mm"
    fit: FitSchema
    pose: PoseSchema
    uncertainty: Literal["laplace", "ensemble", "none"]
    seed: int
    observations: int = Field(description="number of point observations")
    planes: list[PlaneSchema] = Field(description="the annotated planes that were used")
    residuals: list[ResidualSchema]
    volume_ml: EstimateSchema
    area_cm2: EstimateSchema
    extents: list[ExtentSchema]
    surface_sd: SurfaceSdSummary | None
    log_prior_density_nats: float
    typicality_percentile: float = Field(
        description="percentage of real shapes, soundly drawn, that look less like the population, 0 to 100"
    )
    warnings: list[str]


class ResultSummary(Summary):
    """A reconstruction that is kept."""

    id: str
    created: datetime
    expires: datetime
    links: Links


class SurfaceSd(BaseModel):
    """Standard deviation of the surface at each vertex, in the order of the mesh in PLY."""

    space: InputSpace
    unit: Literal["mm"] = "mm"
    surface_sd_mm: list[float]


class GainSchema(BaseModel):
    """A standard deviation now, and as it is expected after the plane was drawn."""

    now: float
    expected: float


class NextPlaneSchema(BaseModel):
    """Where to draw next."""

    space: InputSpace
    unit: Literal["mm"] = "mm"
    plane: PlaneSchema | None = Field(description="plane of voxels of the first mask; null for a free one")
    origin_mm: list[float] = Field(description="a point of the plane, the middle of the expected section")
    normal: list[float] = Field(description="unit vector")
    surface_sd_mm: GainSchema = Field(description="mean standard deviation of the surface along its normal")
    volume_sd_ml: GainSchema = Field(description="standard deviation of the volume")
    considered: int = Field(description="how many planes were compared")


class ModelSummary(BaseModel):
    """A loaded model in short."""

    name: str
    version: str
    structure: str
    digest: str = Field(description="SHA-256 of the bundle")
    link: str


class ModelList(BaseModel):
    """The loaded models."""

    models: list[ModelSummary]


class ActiveDimensions(BaseModel):
    """How many dimensions of the flow's base, largest first, hold so much of the variance of the base."""

    percent_95: int
    percent_97: int
    percent_99: int


class ModelDescription(ModelSummary):
    """Everything a model says about itself."""

    frame: str
    unit: str
    side: str
    latent_size: int
    active_dimensions: ActiveDimensions
    half_extent_mm: list[float]
    resolution_mm: float
    calibration: dict[str, object] = Field(description="how uncertainty was calibrated; empty when it was not")
    training: dict[str, object]
    training_shapes: int
    licence: str
    attribution: str
    accuracy: dict[str, dict[str, float]]


class Health(BaseModel):
    """The process answers."""

    status: Literal["ok"] = "ok"


class BrokenModelSchema(BaseModel):
    """A model that could not be loaded."""

    name: str
    reason: str


class Readiness(BaseModel):
    """What the service can do now."""

    status: Literal["ready"] = "ready"
    models: list[str]
    broken: list[BrokenModelSchema]


class Problem(BaseModel):
    """What went wrong (RFC 9457)."""

    type: str = Field(description="stable name of the kind of problem")
    title: str
    status: int
    detail: str = Field(description="a sentence that names the offending part and what would be accepted")
    part: str | None = Field(None, description="the offending part, for example mask[1] or resolution_mm")
    request_id: str | None = Field(None, description="the request in the service's logs")
    problem_type: str | None = Field(None, description="of a job that failed: `type` of what went wrong")
    problem_status: int | None = Field(None, description="of a job that failed: HTTP status of that type")
