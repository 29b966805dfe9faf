"""How far an ensemble's surfaces lie from the fit's, along its normals.

To first order a member moves the surface as its step of code and pose does. What that misses varies slowly over the
surface, so each member's own field is evaluated at some of the vertices and the difference is carried to the others, as
a control variate: a fifth of the network's work (docs/method.md has what it costs in accuracy).
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from model.bundle import ShapeModel
from model.inference.fitting import Fit, pose_offset
from model.inference.mesh import Mesh
from model.inference.posterior import FieldDerivatives, fitted_jacobians, model_logits, normal_displacements

#: Members' fields are evaluated at one vertex of so many.
EVERY = 5
#: Differences are carried over from so many of them ...
NEIGHBOURS = 4
#: ... those on the other side of a thin part lie this much further off (mm).
APART_MM = 2.0


def member_moves(
    model: ShapeModel, found: Fit, members: Sequence[Fit], mesh: Mesh, known: FieldDerivatives | None = None
) -> Float[np.ndarray, "v m"]:
    """Outward movement (mm) of each vertex from the fit's surface to each member's.

    Args:
        known: derivatives of the fit's field at the vertices, where somebody has them already.
    """
    _, by_parameter, by_point = fitted_jacobians(model, found, mesh.vertices, known)
    steps = np.stack([_step(found, member) for member in members], axis=1)
    linear = normal_displacements(by_parameter @ steps, by_point)
    rows = np.arange(0, len(linear), EVERY)
    exact = normal_displacements(_field_changes(model, found, members, mesh.vertices[rows]), by_point[rows])
    return np.asarray(linear + _carried(mesh, rows, exact - linear[rows]))


def _step(found: Fit, member: Fit) -> Float[np.ndarray, "p"]:
    return np.concatenate([member.latent - found.latent, pose_offset(found.pose, member.pose)])


def _field_changes(
    model: ShapeModel, found: Fit, members: Sequence[Fit], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n m"]:
    """What each member's logits are more than the fit's; its discrepancy is taken where the fit has those points."""
    everyone = (found, *members)
    logits = np.stack([model_logits(model, one, points) for one in everyone], axis=1).astype(float)
    if found.discrepancy is not None:
        canonical = found.pose.to_canonical(points)
        residuals = np.stack([one.discrepancy.residuals for one in everyone if one.discrepancy is not None], axis=1)
        means = found.discrepancy.means_of(residuals, canonical)
        levels = np.stack([found.discrepancy.levels.at(column, canonical) for column in logits.T], axis=1)
        logits = found.discrepancy.slope * (levels + means)
    return np.asarray(logits[:, 1:] - logits[:, :1])


def _carried(mesh: Mesh, rows: Int[np.ndarray, "n"], values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "v m"]:
    """Values at some vertices, averaged over those nearest to each by the inverse square of their distance."""
    places = np.hstack([mesh.vertices, APART_MM * mesh.normals])
    distance, near = cKDTree(places[rows]).query(places, k=range(1, min(NEIGHBOURS, len(rows)) + 1))
    weights = 1.0 / np.square(np.maximum(distance, 1e-6))
    weights /= weights.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("vk,vkm->vm", weights, values[near]))
