"""From the posterior to what users read: probability and entropy of voxels, SD of the surface, intervals.

All spread on the surface comes from `SurfaceSpread`: the covariance of the vertices' outward movements, by the Laplace
posterior over code and pose or by an ensemble of these, and in either case by what the discrepancy leaves open and by
the error that all contours share.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from scipy.special import expit

from model.bundle import ShapeModel
from model.geometry import Grid
from model.inference.discrepancy.levels import REACH_MM
from model.inference.estimates import Estimate, estimate_of
from model.inference.fitting import Fit
from model.inference.member_moves import member_moves
from model.inference.mesh import Mesh, area_cm2, area_gradient, vertex_areas, volume_ml
from model.inference.posterior import (
    FieldDerivatives,
    chunks,
    field_derivatives,
    fitted_jacobians,
    fitted_logits,
    logit_variance,
    mean_probability,
    model_logits,
    normal_displacements,
    open_variance,
)
from model.inference.spread import LocalSpread, SurfaceSpread
from model.inference.voxels import SLAB, inside_mask, slabs_in_box

#: Beyond this logit the posterior variance cannot move a probability visibly.
SATURATED_LOGIT = 12.0
#: A field that counts distances up to some reach only is decided beyond this share of it.
DECIDED_SHARE = 0.9
#: Farther than this from the fit's surface (mm) no member of an ensemble has another label.
FAR_MM = 8.0


@dataclass(frozen=True)
class ShapeState:
    """What is needed to evaluate the reconstructed field anywhere.

    Attributes:
        fits: the fit, followed by the ensemble's members if there are any.
        covariance: (p, p) posterior covariance over (latent, pose step) of the first fit, or None.
    """

    fits: tuple[Fit, ...]
    covariance: Float[np.ndarray, "p p"] | None

    @property
    def members(self) -> tuple[Fit, ...]:
        """The ensemble's members."""
        return self.fits[1:]


def surface_spread(
    model: ShapeModel, state: ShapeState, mesh: Mesh, known: FieldDerivatives | None = None
) -> SurfaceSpread | None:
    """Posterior of the vertices' outward movement, or None without uncertainty.

    Args:
        known: derivatives of the fit's field at the vertices, where somebody has them already.
    """
    found = state.fits[0]
    if state.covariance is None and not state.members:
        return None
    canonical = found.pose.to_canonical(mesh.vertices)
    known = field_derivatives(model, found, canonical) if known is None else known
    scale, offset_mm = calibrated_scale(model)
    by_parameter, local = _held(found, canonical, known, scale)
    if state.covariance is not None:
        roots = (scale * np.linalg.cholesky(state.covariance)).astype(np.float32)
        by_point = found.pose.gradient_to_world(known.by_point).astype(np.float32)
        factors = normal_displacements(by_parameter.astype(np.float32), by_point) @ roots
    else:
        moves = member_moves(model, found, state.members, mesh, known)
        factors = (moves - moves.mean(axis=1, keepdims=True)) / np.sqrt(len(state.members) - 1)
    shared = np.full((len(canonical), 1), offset_mm, factors.dtype)
    return SurfaceSpread(np.concatenate([factors, shared, end_moves(found, mesh.normals)], axis=1), local)


def end_moves(found: Fit, across: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n t"]:
    """What is open because it is not known by what rule thick slices were drawn: both ends move out, or both in.

    Args:
        across: normals of a surface, or gradients of a field, at points (world).

    Returns:
        Outward movements (mm), or changes of the field, for an SD of each direction's rule; none without thick slices.
    """
    if found.thick_doubt is None:
        return np.zeros((len(across), 0), np.float32)
    return np.asarray(np.abs(across @ found.thick_doubt.T), np.float32)


def calibrated_scale(model: ShapeModel) -> tuple[float, float]:
    """Factor on posterior SDs of the surface, and SD (mm) of an error that the whole surface shares.

    The posterior knows neither that its approximations make it too narrow or too wide for the model, nor errors that
    all contours have in common, such as half a voxel to one side. Both move figures of the whole surface most.
    """
    known = model.manifest.posterior
    return known.get("sd_scale", 1.0), known.get("offset_mm", 0.0)


def sharpness_of(model: ShapeModel) -> float:
    """Factor on logits of a Laplace posterior before probabilities are taken of them.

    By themselves they are soft by what codes do not tell, and part of that doubt is the posterior's.
    """
    return model.manifest.posterior.get("sharpness", 1.0)


def uncalibrated(model: ShapeModel, sd_mm: Float[np.ndarray, "v"]) -> Float[np.ndarray, "v"]:
    """Posterior SD of vertices (mm) before `calibrated_scale` widened or narrowed it."""
    scale, offset = calibrated_scale(model)
    return np.asarray(np.sqrt(np.maximum(np.square(sd_mm) - offset**2, 0.0)) / scale)


def _held(
    found: Fit, canonical: Float[np.ndarray, "v 3"], known: FieldDerivatives, scale: float
) -> tuple[Float[np.ndarray, "v p"], LocalSpread | None]:
    """Derivatives of the field by code and pose where the contours hold it, and what the discrepancy leaves open."""
    if found.discrepancy is None:
        return known.by_parameter, None
    carried, variance = found.discrepancy.held(canonical)
    by_point = found.pose.gradient_to_world(known.by_point).astype(np.float32)
    moves = np.full((len(by_point), 1), scale * found.discrepancy.slope, np.float32)
    reach = normal_displacements(moves, by_point)[:, 0]
    by_parameter = known.by_parameter - found.discrepancy.slope * carried
    return by_parameter, LocalSpread(found.discrepancy, canonical, variance, reach)


def volume_estimate(mesh: Mesh, spread: SurfaceSpread | None) -> Estimate:
    """Enclosed volume (mL); a vertex that moves out by 1 mm adds its area."""
    return estimate_of(volume_ml(mesh), vertex_areas(mesh) / 1000.0, spread)


def area_estimate(mesh: Mesh, spread: SurfaceSpread | None) -> Estimate:
    """Surface area (cm^2)."""
    return estimate_of(area_cm2(mesh), np.sum(area_gradient(mesh) * mesh.normals, axis=1) / 100.0, spread)


def occupancy(model: ShapeModel, state: ShapeState, grid: Grid) -> Float[np.ndarray, "i j k"]:
    """Posterior mean occupancy probability at the voxel centres of a grid; 0 outside the model's box."""
    if state.members:
        return _mean_of_members(model, state, grid)
    result = np.zeros(grid.shape, np.float32)
    for index, points in slabs_in_box(model, state.fits[0], grid):
        result[tuple(index.T)] = _probabilities(model, state, points)
    return result


def _probabilities(model: ShapeModel, state: ShapeState, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    return np.concatenate([_piece(model, state, chunk) for chunk in chunks(points)])


def _piece(model: ShapeModel, state: ShapeState, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    found = state.fits[0]
    logits, is_open = _logits(model, found, points)
    result = _sigmoid(logits)
    if state.covariance is not None and is_open.any():
        near = points[is_open]
        centre, by_parameter, by_point = fitted_jacobians(model, found, near)
        variance = settled_variance(found, state.covariance, by_parameter, by_point) + open_variance(found, near)
        result[is_open] = mean_probability(centre, variance, sharpness_of(model))
    return result


def settled_variance(
    found: Fit,
    covariance: Float[np.ndarray, "p p"],
    by_parameter: Float[np.ndarray, "n p"],
    by_point: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n"]:
    """Posterior variance of each logit by code and pose, and by the rule of thick slices: all but the discrepancy's.

    Args:
        by_parameter, by_point: derivatives of the logits as `fitted_jacobians` gives them.
    """
    return np.asarray(logit_variance(by_parameter, covariance) + _variance_by_rule(found, by_point))


def _variance_by_rule(found: Fit, by_point: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    return np.asarray(np.square(end_moves(found, by_point)).sum(axis=1))


def _logits(
    model: ShapeModel, found: Fit, points: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Logits of the field, and where they are not beyond doubt.

    A discrepancy bounds them. Where it has nothing to object they are the code's own, so that the background is empty.
    """
    by_code, discrepancy = model_logits(model, found, points), found.discrepancy
    if discrepancy is None:
        return by_code, np.abs(by_code) < SATURATED_LOGIT
    logits = discrepancy.corrected(by_code, found.pose.to_canonical(points))
    agreed = logits * np.sign(by_code) >= DECIDED_SHARE * REACH_MM * discrepancy.slope
    is_open = ~agreed | (np.abs(by_code) < SATURATED_LOGIT)
    return np.where(is_open, logits, by_code), is_open


def _mean_of_members(model: ShapeModel, state: ShapeState, grid: Grid) -> Float[np.ndarray, "i j k"]:
    """Mean probability over an ensemble; far from the fit's surface all members agree with it."""
    found = state.fits[0]
    inside = inside_mask(model, found, grid)
    result, near = inside.astype(np.float32), _near_border(inside, grid.spacing)
    for index, points in slabs_in_box(model, found, grid):
        close = near[tuple(index.T)]
        if close.any():
            result[tuple(index[close].T)] = _member_probabilities(model, state, points[close])
    return result


def _member_probabilities(
    model: ShapeModel, state: ShapeState, points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n"]:
    """Mean probability over an ensemble at world points (mm).

    Members' own logits are as soft as they are: what the discrepancy leaves open is not added to them. By what rule
    thick slices were drawn is as open to members as to the fit.
    """
    found, doubt = state.fits[0], np.zeros(len(points))
    if found.thick_doubt is not None:
        by_point = field_derivatives(model, found, found.pose.to_canonical(points)).by_point
        doubt = _variance_by_rule(found, found.pose.gradient_to_world(by_point))
    members = [mean_probability(fitted_logits(model, member, points), doubt) for member in state.members]
    return np.asarray(np.mean(members, axis=0))


def _near_border(inside: Bool[np.ndarray, "i j k"], spacing: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "i j k"]:
    """Voxels within `FAR_MM` of others of another label; all where there is but one label.

    Some layers at a time, with as many around them as may matter.
    """
    if inside.all() or not inside.any():
        return np.ones(inside.shape, bool)
    result = np.zeros(inside.shape, bool)
    around, layers = int(np.ceil(FAR_MM / spacing[0])), max(1, SLAB // inside[0].size)
    for first in range(0, len(inside), layers):
        before = max(0, first - around)
        labels = inside[before : first + layers + around]
        distance = np.full(labels.shape, np.inf)
        for one in (labels, ~labels):
            if not one.all():
                np.copyto(distance, distance_transform_edt(one, spacing), where=one)
        result[first : first + layers] = distance[first - before :][:layers] <= FAR_MM
    return result


def voxel_entropy(probability: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """Entropy of a Bernoulli variable (nats), 0 to ln 2."""
    p = np.clip(probability.astype(float), 1e-12, 1.0 - 1e-12)
    return np.asarray(-(p * np.log(p) + (1.0 - p) * np.log1p(-p)), dtype=np.float32)


def _sigmoid(logits: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    return np.asarray(expit(logits.astype(float)))
