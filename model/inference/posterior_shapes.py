"""Shapes drawn from the posterior of one reconstruction: code, pose and discrepancy together.

A draw of code and pose comes from the Laplace posterior; the contours then hold the surface as they hold the fit's, so
the discrepancy is observed anew at them and a draw of it added. An ensemble's draws are its members. Of either the ends
move as far as the rule is open by which thick slices were drawn.
"""

from dataclasses import dataclass, replace

import numpy as np

from model.bundle import ShapeModel
from model.inference.discrepancy.conditioning import observed_anew
from model.inference.discrepancy.draws import drawn
from model.inference.fitting import Fit
from model.inference.mesh import Mesh
from model.inference.objective import Place
from model.inference.surface import surface_of
from model.inference.uncertainty import ShapeState, calibrated_scale, end_moves


@dataclass(frozen=True)
class PosteriorShape:
    """One draw.

    Attributes:
        fit: code, pose and discrepancy.
        mesh: its surface, world RAS mm; empty where the draw has none.
    """

    fit: Fit
    mesh: Mesh


def draw_posterior(model: ShapeModel, state: ShapeState, seed: int, step_mm: float | None = None) -> PosteriorShape:
    """One draw, a pure function of its arguments.

    Args:
        state: of a reconstruction with uncertainty.
        seed: non-negative.
        step_mm: grid step of the surface; the model's own when None.
    """
    chosen, shift_mm = (_member(state, seed), 0.0) if state.members else _around(model, state, seed)
    mesh = surface_of(model, chosen.latent, chosen.pose, step_mm, chosen.discrepancy)
    ends = end_moves(state.fits[0], mesh.normals)
    moved_mm = shift_mm + ends @ np.random.default_rng([seed, 1]).standard_normal(ends.shape[1])
    return PosteriorShape(chosen, replace(mesh, vertices=mesh.vertices + moved_mm[:, None] * mesh.normals))


def _member(state: ShapeState, seed: int) -> Fit:
    """Members in a random order, each once before any comes again."""
    count = len(state.members)
    order = np.random.default_rng(seed // count).permutation(count)
    return state.members[int(order[seed % count])]


def _around(model: ShapeModel, state: ShapeState, seed: int) -> tuple[Fit, float]:
    """A draw, and how far (mm) the error that all of the surface shares moves it out, where no discrepancy holds it."""
    if state.covariance is None:
        raise ValueError("a state without uncertainty has no posterior to draw from")
    found, random = state.fits[0], np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(state.covariance)
    scale, offset = calibrated_scale(model)
    step = scale * vectors @ (np.sqrt(np.maximum(values, 0.0)) * random.standard_normal(len(values)))
    place = Place(found.latent, found.pose).moved(step)
    (held,) = observed_anew(model, found, [place])
    moved = replace(found, latent=place.latent, pose=place.pose)
    shift = offset * float(random.standard_normal())
    if held is None:
        return moved, shift
    return replace(moved, discrepancy=drawn(held, int(random.integers(2**32)), scale, shift)), 0.0
