"""Wire types of what the HTTP interface is asked: forms, queries and their parameters. They stop at the routes."""

import json
from typing import Annotated, Literal

from fastapi import UploadFile
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from model.errors import InvalidParameter
from model.geometry import Space
from model.inference.calipers import USUAL_TEXT, parse_extents
from model.inference.next_plane import Among
from model.inference.observations import AnnotatedRule, Plane
from model.inference.reconstruction import Options
from service.ports import MeshFormat, SampleFormat
from service.use_cases import MAX_SEED

SpacingMm = Annotated[float, Field(ge=0.25, le=10.0, allow_inf_nan=False, description="grid step (mm)")]
#: Largest label; masks of 32 bits hold it.
MAX_LABEL = 2**31 - 1
#: Different planes that a request may name: all those of eight masks of 512 slices.
MOST_PLANES = 4096
#: Description of the part `extents`.
EXTENTS = (
    "extents of the surface to measure, separated by commas: R, A and S along the axes of the body, longest between "
    "any two points, or a direction of the input's world as three numbers with blanks between them, such as 0.5 0 0.87"
)
#: World of a mesh that is asked for.
AskedSpace = Annotated[
    Space | None, Field(description="world of the coordinates, RAS or LPS; the input's when left out")
]
Seed = Annotated[int, Field(ge=0, le=MAX_SEED, description="makes the answer repeatable")]


class _Closed(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ReconstructionForm(_Closed):
    """The parts of a reconstruction request."""

    mask: list[UploadFile] = Field(
        min_length=1,
        description="sparse segmentation (NIfTI, NRRD, seg.nrrd, MetaImage, DICOM SEG or RTSTRUCT); several files are "
        "several stacks of the same object, each with its own grid; the first one's grid is the input's grid",
    )
    model: str | None = Field(None, description="model name; may be left out when only one is loaded")
    label: list[str] = Field(
        default_factory=list,
        description="label value or values of the object, repeated or separated by commas; all non-zero when left out",
    )
    annotated: str = Field(
        "auto",
        description='auto, all, nonempty, or a JSON list of planes such as [{"stack": 0, "axis": 2, "index": 7}]; '
        f"stack is 0 when left out; at most {MOST_PLANES} different planes",
    )
    uncertainty: Literal["laplace", "ensemble", "none"] = Field("laplace", description="how uncertainty is found")
    mirror: Literal["auto", "never", "always"] = Field("never", description="whether left and right are exchanged")
    resolution_mm: SpacingMm | None = Field(
        None,
        description="grid step of the surface (mm); the model's when left out. Figures of the summary are measured at "
        "the model's step where this one is coarser",
    )
    seed: Seed = 0
    fidelity: float | None = Field(
        None,
        ge=0.0,
        le=1.0,
        allow_inf_nan=False,
        description="0 trusts the model, 1 trusts the slices: share of what the model leaves unexplained on the slices "
        "that the surface follows; the one calibrated for the model when left out",
    )
    extents: str = Field(USUAL_TEXT, description=EXTENTS)

    def options(self) -> Options:
        """The choices as domain types."""
        annotated = parse_annotated(self.annotated)
        choices = self.uncertainty, self.mirror, self.resolution_mm, self.seed, self.fidelity
        return Options(annotated, *choices, parse_extents(self.extents))


class PlanesForm(_Closed):
    """The parts of a request for annotated planes."""

    mask: list[UploadFile] = Field(min_length=1, description="as of a reconstruction")
    label: list[str] = Field(default_factory=list, description="as of a reconstruction")
    annotated: str = Field("auto", description="as of a reconstruction")


class ComparisonQuery(_Closed):
    """Query of a comparison."""

    other: str = Field(description="identifier of the result that is compared with")
    format: Literal["ply", "glb", "vtp", "mz3"] = Field("ply", description="file format")
    space: AskedSpace = None


class MeshQuery(_Closed):
    """Query of a mesh."""

    format: MeshFormat = Field(
        MeshFormat.PLY, description="file format; when left out, the one that the header Accept likes best"
    )
    space: AskedSpace = None
    max_error_mm: float = Field(
        0.0,
        ge=0.0,
        le=10.0,
        allow_inf_nan=False,
        description="fewer triangles, at samples of both no farther than this (mm) from the full surface",
    )


class VolumeQuery(_Closed):
    """Query of a volume."""

    spacing_mm: SpacingMm | None = Field(None, description="grid step (mm); the input's grid when left out")


class UncertaintyQuery(VolumeQuery):
    """Query of an uncertainty."""

    kind: Literal["entropy", "surface_sd"] = Field(
        "entropy", description="voxel entropy (nats, NIfTI) or standard deviation of the surface (mm, JSON)"
    )


class PosteriorQuery(_Closed):
    """Query of shapes from the posterior."""

    format: MeshFormat = Field(MeshFormat.PLY, description="file format")
    count: int = Field(16, ge=1, description="how many; larger than the service's limit is refused with 413")
    seed: Seed = 0
    spacing_mm: SpacingMm | None = Field(None, description="grid step (mm); that of the result when left out")


class NextPlaneQuery(_Closed):
    """Query of the plane to draw next."""

    planes: Among = Field(
        "grid",
        description="which planes compete: grid (those of the input's grid, along all three axes) or free (any)",
    )


class SampleQuery(_Closed):
    """Query of one synthetic shape."""

    format: SampleFormat = Field(SampleFormat.STL, description="file format")
    temperature: float = Field(
        1.0, gt=0.0, le=2.0, allow_inf_nan=False, description="spread of the shapes; 1 is the population's"
    )
    spacing_mm: SpacingMm | None = Field(None, description="grid step (mm); the model's when left out")
    reject: bool = Field(
        True,
        description="draw anew where a shape is implausible: several components, a volume out of range, cut by the "
        "border of the model's box, without a surface, or between two clusters of training shapes",
    )


class BatchQuery(SampleQuery):
    """Query of a batch of synthetic shapes."""

    count: int = Field(16, ge=1, description="how many; larger than the service's limit is refused with 413")
    seed: Seed = 0


class PlaneSchema(_Closed):
    """A plane of voxels."""

    stack: int = Field(ge=0, description="number of the mask part")
    axis: int = Field(ge=0, le=2, description="voxel axis that the plane is perpendicular to")
    index: int = Field(ge=0, description="voxel index along the axis")


class _AskedPlane(PlaneSchema):
    stack: int = Field(0, ge=0)


def parse_annotated(text: str) -> AnnotatedRule | tuple[Plane, ...]:
    """The `annotated` parameter.

    Raises:
        InvalidParameter: neither a rule nor a JSON list of planes, or more than `MOST_PLANES` different ones.
    """
    match text.strip():
        case "auto" | "all" | "nonempty" as rule:
            return rule
    try:
        items = json.loads(text, object_pairs_hook=_once)
    except (ValueError, RecursionError):
        items = None
    if not isinstance(items, list) or not items:
        accepted = 'auto, all, nonempty or a JSON list of planes such as [{"stack": 0, "axis": 2, "index": 7}]'
        raise InvalidParameter(f"The parameter annotated must be {accepted}.", part="annotated")
    named = tuple(_named_plane(item, f"annotated[{number}]") for number, item in enumerate(items))
    if (count := len(set(named))) > MOST_PLANES:
        raise InvalidParameter(
            f"The parameter annotated names {count} different planes; at most {MOST_PLANES} are accepted.",
            part="annotated",
        )
    return named


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Members of an object of JSON, none of them twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a member stands twice")
    return found


def _named_plane(item: object, part: str) -> Plane:
    try:
        plane = _AskedPlane.model_validate(item, strict=True)
    except ValidationError:
        raise InvalidParameter(
            f"{part} is no plane; an object with axis (0 to 2), index (from 0) and perhaps stack (from 0) is accepted.",
            part=part,
        ) from None
    return Plane(plane.stack, plane.axis, plane.index)


def parse_labels(texts: list[str]) -> frozenset[int] | None:
    """The `label` parameter: repeated, separated by commas, or not there.

    Raises:
        InvalidParameter: not whole numbers from 1 to `MAX_LABEL`.
    """
    words = [word.strip() for text in texts for word in text.split(",") if text.strip()]
    if not words:
        return None
    numbers = [int(word) for word in words if word.isascii() and word.isdecimal() and len(word) <= 10]
    if len(numbers) < len(words) or not all(1 <= number <= MAX_LABEL for number in numbers):
        raise InvalidParameter(f"The parameter label must be whole numbers from 1 to {MAX_LABEL}.", part="label")
    return frozenset(numbers)
