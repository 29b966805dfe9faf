"""From mask stacks to a surface: the whole way in one function.

observations -> fit -> surface -> uncertainty. Reads no setting, no clock and no global.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.errors import InvalidMask, InvalidParameter
from model.geometry import Space
from model.inference.agreement import disagreeing_planes, plane_warnings, sections_of
from model.inference.annotated_planes import planes_and_repeats, repeat_warnings
from model.inference.calipers import USUAL_EXTENTS, Extent, direction_of, measure_extents
from model.inference.coverage import coverage_warnings
from model.inference.discrepancy.conditioning import DiscrepancyPrior, corrected, discrepancy_prior, observed_anew
from model.inference.ensemble import fit_ensemble
from model.inference.estimates import Estimate
from model.inference.fitting import Fit, FitOptions, MirrorRule, fit
from model.inference.mask_stack import common_space
from model.inference.mesh import Mesh
from model.inference.objective import Place, reweighted
from model.inference.observations import AnnotatedRule, MaskStack, Observations, Plane, observe
from model.inference.one_body import separate_warnings
from model.inference.other_side import nats_of_other_side, other_side_warnings, percentile_beside
from model.inference.posterior import FieldDerivatives, fitted_logits, laplace_covariance
from model.inference.reliability import figures_of, less_trusting, reliability_warnings, thickness_warnings
from model.inference.rivals import rival_warnings
from model.inference.surface import differentiated_surface, require_spacing, require_step, surface_of
from model.inference.thick_slices import through_thickness
from model.inference.typicality import (
    predictive_probabilities,
    predictive_warnings,
    typicality,
    typicality_warnings,
)
from model.inference.uncertainty import ShapeState, area_estimate, surface_spread, uncalibrated, volume_estimate

UncertaintyRule = Literal["laplace", "ensemble", "none"]
#: Called with the name of each stage as it begins: observations, fit, surface, uncertainty.
Watch = Callable[[str], None]
#: Scalar of a surface: standard deviation along its normal (mm).
SURFACE_SD = "surface_sd_mm"

#: Point observations used of all voxels on the annotated planes.
OBSERVATION_BUDGET = 2500
#: Of them at most so many off the contours for each one near them.
COVER_SHARE_OF_BAND = 0.6
#: What answers by an ensemble are told of.
UNCALIBRATED = (
    "Intervals and standard deviations by an ensemble are not calibrated, and hold the truth less often than they say; "
    "those of uncertainty=laplace are calibrated."
)


@dataclass(frozen=True)
class Options:
    """What a caller may choose; names and meanings are those of the REST interface.

    Attributes:
        annotated: which planes were looked at.
        uncertainty: how uncertainty is found.
        mirror: whether left and right may be exchanged.
        resolution_mm: grid step of the surface; the model's own when None. Figures are never taken from a coarser one
            than the model's own, which would be smaller than the body.
        seed: makes the answer repeatable.
        fidelity: from 0, trust the model, to 1, trust the slices: share of what the code leaves unexplained on the
            slices that the surface follows; the one calibrated for the model when None.
        extents: what is measured of the surface, see `model.inference.calipers`.
    """

    annotated: AnnotatedRule | tuple[Plane, ...] = "auto"
    uncertainty: UncertaintyRule = "laplace"
    mirror: MirrorRule = "never"
    resolution_mm: float | None = None
    seed: int = 0
    fidelity: float | None = None
    extents: tuple[str, ...] = USUAL_EXTENTS


@dataclass(frozen=True)
class PlaneResidual:
    """How far one drawn plane and the reconstruction's section disagree.

    Attributes:
        plane: which plane.
        disagreement: 1 - Dice between the drawing and the reconstruction's section, 0 to 1.
        mean_error: mean signed occupancy residual (label minus probability).
        predictive_p: how probable it is that a sound drawing disagrees at least as much with its reconstruction; None
            where the model does not know.
    """

    plane: Plane
    disagreement: float
    mean_error: float
    predictive_p: float | None = None


@dataclass(frozen=True)
class Reconstruction:
    """The answer; all coordinates are world RAS mm, whatever `space` says.

    Attributes:
        state: evaluates the field; `occupancy` takes it.
        mesh: watertight surface; with uncertainty its scalar `SURFACE_SD` is there.
        planes: planes that were used.
        observation_count: number of point observations.
        residuals: disagreement of each plane.
        volume_ml, area_cm2, extents: figures with 90 % intervals.
        log_prior_density: nats.
        typicality_percentile: percentage of real shapes that are less like the population, 0 to 100.
        warnings: plain sentences, for example that the shape is unlike the training population.
        space: world in which the coordinates are to be told, that of the stacks.
    """

    state: ShapeState
    mesh: Mesh
    planes: tuple[Plane, ...]
    observation_count: int
    residuals: tuple[PlaneResidual, ...]
    volume_ml: Estimate
    area_cm2: Estimate
    extents: tuple[Extent, ...]
    log_prior_density: float
    typicality_percentile: float
    warnings: tuple[str, ...]
    space: Space = "RAS"


def farthest_mm(model: ShapeModel) -> float:
    """How far apart (mm) two sections of one object may lie: the longest side of the model's box."""
    return 2.0 * max(model.manifest.half_extent_mm)


def unwatched(_: str) -> None:
    """A `Watch` that does nothing."""


def reconstruct(
    model: ShapeModel,
    stacks: Sequence[MaskStack],
    options: Options,
    watch: Watch = unwatched,
    max_voxels: int | None = None,
) -> Reconstruction:
    """Fit the model to the stacks and extract surface and uncertainty.

    Args:
        max_voxels: of the grid in which the surface is looked for; any number when None.

    Raises:
        InvalidMask: no foreground, or everything in one plane.
        InconsistentStacks: the stacks cannot be of one object.
        InvalidParameter: an option out of its range.
        TooLarge: the grid of the surface has more voxels than allowed.
    """
    _check(options)
    _require_room(model, options, max_voxels)
    watch("observations")
    planes, again = planes_and_repeats(stacks, options.annotated, farthest_mm(model))
    drawing = observe(stacks, planes, budget=OBSERVATION_BUDGET, cover=COVER_SHARE_OF_BAND, seed=options.seed)
    watch("fit")
    usual, trusting = discrepancy_prior(model.manifest), model
    model, settled, observations = _settled(model, stacks, drawing, FitOptions(mirror=options.mirror), usual)
    found = corrected(model, settled, stacks, drawing, discrepancy_prior(model.manifest, options.fidelity))
    watch("surface")
    _require_room(model, options, max_voxels, found)
    mesh, derivatives = _surface(model, found, options, _judged_step(model, options))
    if mesh.is_empty:
        raise InvalidMask(
            f"The drawing has nothing in common with a {model.manifest.structure}, no shape of it comes near; "
            "drawings of the model's own structure are accepted.",
            part="mask",
        )
    watch("uncertainty")
    state = _state(model, observations, found, options)
    spread = surface_spread(model, state, mesh, derivatives)
    sd_mm = None if spread is None else spread.sd()
    plain_sd = None if sd_mm is None or state.covariance is None else uncalibrated(model, sd_mm)
    trusted = observations if found.plane_weights is None else reweighted(observations, found.plane_weights)
    space = common_space(stacks)
    logits = fitted_logits(model, found, observations.points)
    sections = sections_of(observations, logits, found.plane_weights)
    figures = figures_of(model, found, stacks, drawing, mesh, usual, plain_sd)
    thick = thickness_warnings(stacks, observations.planes, mesh)
    judged = replace(figures, misfit_mm=0.0) if thick else figures
    density, percentile = typicality(model, found, judged)
    other_side = nats_of_other_side(trusting, trusted, found, judged, options.mirror)
    percentile = percentile_beside(percentile, other_side)
    probabilities = predictive_probabilities(model, sections)
    named = [*disagreeing_planes(sections), *filter(None, [_doubted(observations, found)])]
    return Reconstruction(
        state=state,
        mesh=_delivered(model, state, options, mesh, sd_mm),
        planes=observations.planes,
        observation_count=len(observations.points),
        residuals=tuple(
            PlaneResidual(s.plane, s.disagreement, s.mean_error, p)
            for s, p in zip(sections, probabilities, strict=True)
        ),
        volume_ml=volume_estimate(mesh, spread),
        area_cm2=area_estimate(mesh, spread),
        extents=measure_extents(mesh, spread, options.extents, space),
        log_prior_density=density,
        typicality_percentile=percentile,
        warnings=repeat_warnings(stacks, again)
        + _warnings(found, options)
        + separate_warnings(observations, logits, mesh)
        + rival_warnings(found)
        + typicality_warnings(model, percentile)
        + other_side_warnings(other_side)
        + plane_warnings(sections, _doubted(observations, found))
        + predictive_warnings(sections, probabilities, named)
        + coverage_warnings(trusted, mesh.vertices)
        + reliability_warnings(model.manifest.usual, figures, stacks, observations.planes, mesh),
        space=space,
    )


def _settled(
    model: ShapeModel, stacks: Sequence[MaskStack], drawing: Observations, options: FitOptions, usual: DiscrepancyPrior
) -> tuple[ShapeModel, Fit, Observations]:
    """Fit of code and pose, the model with as much trust in the drawing as it deserves, and observations in place."""
    found, observations = through_thickness(model, fit(model, drawing, options), stacks, drawing, options)
    trusting, found = less_trusting(model, found, stacks, observations, options, usual)
    return trusting, found, observations


def _judged_step(model: ShapeModel, options: Options) -> float | None:
    """Grid step (mm) of the surface that figures are taken from: chords of a coarser one would cut off its bends."""
    step = options.resolution_mm
    return None if step is None or step >= model.manifest.resolution_mm else step


def _surface(
    model: ShapeModel, found: Fit, options: Options, step_mm: float | None
) -> tuple[Mesh, FieldDerivatives | None]:
    """The surface, and what its uncertainty will need of the field at its vertices."""
    if options.uncertainty == "none":
        return surface_of(model, found.latent, found.pose, step_mm, found.discrepancy), None
    return differentiated_surface(model, found, step_mm)


def _delivered(
    model: ShapeModel, state: ShapeState, options: Options, judged: Mesh, sd_mm: Float[np.ndarray, "v"] | None
) -> Mesh:
    """The surface at the step that was asked for, with its SD where there is uncertainty."""
    mesh = judged
    if options.resolution_mm is not None and _judged_step(model, options) is None:
        mesh, derivatives = _surface(model, state.fits[0], options, options.resolution_mm)
        spread = surface_spread(model, state, mesh, derivatives)
        sd_mm = None if spread is None else spread.sd()
    return mesh if sd_mm is None else replace(mesh, scalars={SURFACE_SD: sd_mm})


def _require_room(model: ShapeModel, options: Options, max_voxels: int | None, found: Fit | None = None) -> None:
    """Refuse a step that is too fine for the model's own size, or for the size that was found."""
    if max_voxels is not None:
        log_scale = 0.0 if found is None else found.pose.log_scale
        require_step(model, options.resolution_mm, max_voxels, part="resolution_mm", log_scale=log_scale)


def _check(options: Options) -> None:
    require_spacing(options.resolution_mm, part="resolution_mm")
    for part, chosen, rules in (
        ("annotated", options.annotated, AnnotatedRule),
        ("uncertainty", options.uncertainty, UncertaintyRule),
        ("mirror", options.mirror, MirrorRule),
    ):
        if isinstance(chosen, str) and chosen not in get_args(rules):
            raise InvalidParameter(f"{part} is {chosen}; {', '.join(get_args(rules))} are accepted.", part=part)
    if options.fidelity is not None and not 0.0 <= options.fidelity <= 1.0:
        raise InvalidParameter(
            f"fidelity is {options.fidelity:g}; 0 (trust the model) to 1 (trust the slices) is accepted.",
            part="fidelity",
        )
    for along in options.extents:
        direction_of(along)
    if options.seed < 0:
        raise InvalidParameter(f"seed is {options.seed}; a whole number from 0 is accepted.", part="seed")


def _state(model: ShapeModel, observations: Observations, found: Fit, options: Options) -> ShapeState:
    """The fit and its posterior; the contours hold the members of an ensemble as they hold the fit."""
    if options.uncertainty == "ensemble":
        members = fit_ensemble(model, observations, found, options.seed)
        seen = observed_anew(model, found, [Place(one.latent, one.pose) for one in members])
        held = (replace(one, discrepancy=anew) for one, anew in zip(members, seen, strict=True))
        return ShapeState((found, *held), None)
    return ShapeState((found,), laplace_covariance(found) if options.uncertainty == "laplace" else None)


def _doubted(observations: Observations, found: Fit) -> Plane | None:
    return None if found.doubted is None else observations.planes[found.doubted]


def _warnings(found: Fit, options: Options) -> tuple[str, ...]:
    stopped = () if found.status == "converged" else (found.message,)
    return (*stopped, UNCALIBRATED) if options.uncertainty == "ensemble" else stopped
