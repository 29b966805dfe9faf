"""Domain types to wire types: what a client reads of an outcome and of a model."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from model.bundle import ShapeModel
from model.geometry import Space, ras_to
from model.inference.estimates import Estimate, sd_of_estimate
from model.inference.mask_stack import MaskStack, Plane, section_of
from model.inference.next_plane import NextPlane
from model.inference.reconstruction import SURFACE_SD
from service.cautions import grid_cautions
from service.colours import RAMP
from service.ports import Outcome, StoredResult
from service.request_schemas import PlaneSchema
from service.schemas import (
    ActiveDimensions,
    ColourLegend,
    DrawnPlanes,
    DrawnPlaneSchema,
    EstimateSchema,
    ExtentSchema,
    FitSchema,
    GainSchema,
    Links,
    ModelDescription,
    ModelReference,
    ModelSummary,
    NextPlaneSchema,
    PoseSchema,
    ResidualSchema,
    ResultSummary,
    StackSchema,
    Summary,
    SurfaceSdSummary,
)
from service.use_cases import notes_of


def summary_of(outcome: Outcome) -> Summary:
    """The wire form of an outcome, in the input's world."""
    answer = outcome.reconstruction
    space = answer.space
    fit = answer.state.fits[0]
    pose = fit.pose
    sd = answer.mesh.scalars.get(SURFACE_SD)
    return Summary(
        model=ModelReference(name=outcome.model_name, version=outcome.model_version, digest=outcome.model_digest),
        space=space,
        fit=FitSchema(
            status=fit.status.value,
            converged=fit.status.value == "converged",
            message=fit.message,
            iterations=fit.iterations,
        ),
        pose=PoseSchema(
            position_mm=_told(pose.position, space),
            rotation=[_told(row, space) for row in pose.rotation],
            scale=math.exp(pose.log_scale),
            mirrored=pose.mirrored,
        ),
        uncertainty=outcome.options.uncertainty,
        seed=outcome.options.seed,
        observations=answer.observation_count,
        planes=[_plane(plane) for plane in answer.planes],
        residuals=[
            ResidualSchema(
                plane=_plane(r.plane),
                disagreement=r.disagreement,
                mean_error=r.mean_error,
                predictive_p=r.predictive_p,
            )
            for r in answer.residuals
        ],
        volume_ml=_estimate(answer.volume_ml),
        area_cm2=_estimate(answer.area_cm2),
        extents=[
            ExtentSchema(along=e.along, direction=_told(np.array(e.direction), space), extent_mm=_estimate(e.extent_mm))
            for e in answer.extents
        ],
        surface_sd=None if sd is None else _surface_sd(sd),
        log_prior_density_nats=answer.log_prior_density,
        typicality_percentile=answer.typicality_percentile,
        warnings=[*answer.warnings, *grid_cautions(answer.mesh, outcome.grid)],
    )


def result_summary(result: StoredResult, address: str) -> ResultSummary:
    """The wire form of a kept result that stands at an address."""
    uncertain = SURFACE_SD in result.outcome.reconstruction.mesh.scalars
    links = Links(
        self=address,
        mesh=f"{address}/mesh",
        segmentation=f"{address}/segmentation",
        occupancy=f"{address}/occupancy",
        features=f"{address}/features",
        uncertainty=f"{address}/uncertainty" if uncertain else None,
        surface_sd=f"{address}/uncertainty?kind=surface_sd" if uncertain else None,
        posterior=f"{address}/posterior" if uncertain else None,
        next_plane=f"{address}/next-plane" if uncertain else None,
    )
    return ResultSummary(
        id=result.id,
        created=result.created,
        expires=result.expires,
        links=links,
        **summary_of(result.outcome).model_dump(),
    )


def drawn_planes(stacks: Sequence[MaskStack], planes: Sequence[Plane]) -> DrawnPlanes:
    """The wire form of annotated planes."""
    return DrawnPlanes(
        stacks=[
            StackSchema(part=stack.part, shape=list(stack.grid.shape), affine=stack.grid.affine.tolist())
            for stack in stacks
        ],
        planes=[
            DrawnPlaneSchema(
                **_plane(plane).model_dump(), runs=_runs(section_of(stacks[plane.stack].foreground, plane))
            )
            for plane in planes
        ],
        warnings=list(notes_of(stacks)),
    )


def next_plane_summary(outcome: Outcome, found: NextPlane) -> NextPlaneSchema:
    """The wire form of the plane to draw next, of an outcome with uncertainty, in the input's world."""
    answer = outcome.reconstruction
    sd = float(answer.mesh.scalars[SURFACE_SD].mean())
    volume = sd_of_estimate(answer.volume_ml)
    plane = found.cut.plane
    return NextPlaneSchema(
        space=answer.space,
        plane=None if plane is None else _plane(plane),
        origin_mm=_told(found.cut.origin, answer.space),
        normal=_told(found.cut.normal, answer.space),
        surface_sd_mm=GainSchema(now=sd, expected=sd * found.surface_share),
        volume_sd_ml=GainSchema(now=volume, expected=volume * found.volume_share),
        considered=found.considered,
    )


def model_summary(model: ShapeModel, address: str) -> ModelSummary:
    """The wire form of a model in short."""
    manifest = model.manifest
    return ModelSummary(
        name=manifest.name,
        version=manifest.version,
        structure=manifest.structure,
        digest=model.digest,
        link=address,
    )


def model_description(model: ShapeModel, address: str) -> ModelDescription:
    """The wire form of everything a model says about itself."""
    manifest = model.manifest
    low, middle, high = manifest.active_dimensions
    return ModelDescription(
        **model_summary(model, address).model_dump(),
        frame=manifest.frame,
        unit=manifest.units,
        side=manifest.side,
        latent_size=manifest.latent_size,
        active_dimensions=ActiveDimensions(percent_95=low, percent_97=middle, percent_99=high),
        half_extent_mm=list(manifest.half_extent_mm),
        resolution_mm=manifest.resolution_mm,
        calibration=manifest.calibration,
        training=manifest.training,
        training_shapes=len(model.population.codes),
        licence=manifest.licence,
        attribution=manifest.attribution,
        accuracy=manifest.accuracy,
    )


def _told(values: Float[np.ndarray, "3"], space: Space) -> list[float]:
    """A point, a direction or a row of a matrix over RAS, for readers of a space; without a negative zero."""
    told: list[float] = (ras_to(space) @ values + 0.0).tolist()
    return told


def _runs(section: Bool[np.ndarray, "a b"]) -> list[list[int]]:
    """Foreground of a plane as [start, length] of its voxels by rows."""
    change = np.flatnonzero(np.diff(section.ravel(), prepend=False, append=False))
    return [[int(start), int(end - start)] for start, end in zip(change[::2], change[1::2], strict=True)]


def _surface_sd(sd: Float[np.ndarray, "v"]) -> SurfaceSdSummary:
    top = float(sd.max())
    legend = ColourLegend(
        values_mm=[top * number / (len(RAMP) - 1) for number in range(len(RAMP))],
        colours=["#{:02x}{:02x}{:02x}".format(*colour) for colour in RAMP],
    )
    return SurfaceSdSummary(mean_mm=float(sd.mean()), max_mm=top, legend=legend)


def _plane(plane: Plane) -> PlaneSchema:
    return PlaneSchema(stack=plane.stack, axis=plane.axis, index=plane.index)


def _estimate(estimate: Estimate) -> EstimateSchema:
    return EstimateSchema(value=estimate.value, low=estimate.low, high=estimate.high)
