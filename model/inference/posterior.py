"""Laplace approximation of the posterior over latent code, pose and discrepancy, and what follows on the surface.

At the optimum the posterior is taken as Gaussian with the inverse curvature as covariance (MacKay 1992). Everything a
user asks for is first order in the parameters: a logit moves by its Jacobian times the parameter step, and a surface
point moves along its normal by that change over the length of the field's gradient.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cho_factor, cho_solve
from scipy.special import expit

from model.bundle import ShapeModel
from model.inference.fitting import Fit

#: Points evaluated in one call: bounds memory, and how long whoever wants the work ended waits.
CHUNK = 16384


def laplace_covariance(fit: Fit) -> Float[np.ndarray, "p p"]:
    """Inverse of the curvature at the optimum."""
    return np.asarray(cho_solve(cho_factor(fit.precision), np.eye(len(fit.precision))))


def model_logits(model: ShapeModel, fit: Fit, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Occupancy logits of the fitted code and pose alone at world points (mm)."""
    if not len(points):
        return np.zeros(0, np.float32)
    parts = [model.decoder.logits(fit.latent[None], fit.pose.to_canonical(chunk)[None])[0] for chunk in chunks(points)]
    return np.concatenate(parts)


def fitted_logits(model: ShapeModel, fit: Fit, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Occupancy logits of the fitted shape, its discrepancy included, at world points (mm)."""
    logits = model_logits(model, fit, points)
    if fit.discrepancy is None or not len(points):
        return logits
    return fit.discrepancy.corrected(logits, fit.pose.to_canonical(points))


@dataclass(frozen=True)
class FieldDerivatives:
    """A fitted field and its derivatives at points of the canonical frame, before the contours hold it.

    Attributes:
        logits: (n,) of the shape, its discrepancy included.
        by_parameter: (n, p) by (latent, pose step), where the discrepancy does not give way.
        by_point: (n, 3) by canonical point (1/mm).
    """

    logits: Float[np.ndarray, "n"]
    by_parameter: Float[np.ndarray, "n p"]
    by_point: Float[np.ndarray, "n 3"]

    def of(self, rows: Bool[np.ndarray, "n"]) -> "FieldDerivatives":
        """Those at some of the points."""
        return FieldDerivatives(self.logits[rows], self.by_parameter[rows], self.by_point[rows])


def field_derivatives(model: ShapeModel, fit: Fit, canonical: Float[np.ndarray, "n 3"]) -> FieldDerivatives:
    """The fitted field and its derivatives at canonical points (mm)."""
    if not len(canonical):
        return FieldDerivatives(np.zeros(0), np.zeros((0, len(fit.precision))), np.zeros((0, 3)))
    parts = [_derivatives(model, fit, chunk) for chunk in chunks(canonical)]
    if len(parts) == 1:
        return parts[0]
    names = [part.name for part in fields(FieldDerivatives)]
    return FieldDerivatives(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def fitted_jacobians(
    model: ShapeModel, fit: Fit, points: Float[np.ndarray, "n 3"], known: FieldDerivatives | None = None
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n p"], Float[np.ndarray, "n 3"]]:
    """Logits as `fitted_logits` gives them, their derivatives by (latent, pose step), and by world point (1/mm).

    Args:
        points: world mm.
        known: the field's derivatives at these points, where somebody has them already.
    """
    canonical = fit.pose.to_canonical(points)
    found = field_derivatives(model, fit, canonical) if known is None else known
    return found.logits, _held(fit, canonical, found.by_parameter), fit.pose.gradient_to_world(found.by_point)


def _derivatives(model: ShapeModel, fit: Fit, canonical: Float[np.ndarray, "n 3"]) -> FieldDerivatives:
    logits, by_latent, by_point = (
        value[0] for value in model.decoder.logits_and_jacobians(fit.latent[None], canonical[None])
    )
    by_parameter = np.concatenate([by_latent, fit.pose.jacobian(canonical, by_point)], axis=1)
    if fit.discrepancy is None:
        return FieldDerivatives(logits, by_parameter, by_point)
    field, gradient = fit.discrepancy.corrected_with_gradient(logits, by_point, canonical)
    return FieldDerivatives(field, fit.discrepancy.shrinkage(logits)[:, None] * by_parameter, gradient)


def _held(
    fit: Fit, canonical: Float[np.ndarray, "n 3"], by_parameter: Float[np.ndarray, "n p"]
) -> Float[np.ndarray, "n p"]:
    """Derivatives of the field that the contours hold: around them the discrepancy gives way to a parameter."""
    if fit.discrepancy is None:
        return by_parameter
    return np.asarray(by_parameter - fit.discrepancy.slope * fit.discrepancy.carried(canonical))


def chunks(points: Float[np.ndarray, "n 3"]) -> list[Float[np.ndarray, "m 3"]]:
    """Parts of at most `CHUNK` points; one at least."""
    return [points[start : start + CHUNK] for start in range(0, max(len(points), 1), CHUNK)]


def logit_variance(
    by_parameter: Float[np.ndarray, "n p"], covariance: Float[np.ndarray, "p p"]
) -> Float[np.ndarray, "n"]:
    """Posterior variance of each logit by code and pose, ``J C J^T``."""
    return np.asarray(np.einsum("np,np->n", by_parameter @ covariance, by_parameter))


def open_variance(fit: Fit, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Posterior variance of each logit by the discrepancy, at world points (mm)."""
    if fit.discrepancy is None:
        return np.zeros(len(points))
    return fit.discrepancy.slope**2 * fit.discrepancy.variance(fit.pose.to_canonical(points))


def mean_probability(
    logits: Float[np.ndarray, "n"], variance: Float[np.ndarray, "n"], sharpness: float = 1.0
) -> Float[np.ndarray, "n"]:
    """Expected sigmoid of a Gaussian logit, multiplied by the sharpness (MacKay 1992, equation 10)."""
    return np.asarray(expit(sharpness * logits / np.sqrt(1.0 + np.pi * sharpness**2 * variance / 8.0)))


def normal_displacements(
    by_parameter: Float[np.ndarray, "v p"], by_point: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "v p"]:
    """Outward movement of each surface point (mm) for a unit of each parameter."""
    slope = np.linalg.norm(by_point, axis=1, keepdims=True)
    return np.asarray(by_parameter / np.maximum(slope, 1e-6))
