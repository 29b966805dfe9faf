"""Modes of shape: what one standard deviation along each dimension of the flow's base moves.

A dimension's sigma says little by itself: the decoder may hardly heed it. So modes are ranked by the mean square of the
surface's movement along its normal between the mean shape and one SD to both sides. The base is ``N(0, diag(sigma^2))``
with independent dimensions, so these squares add up to the variance of the surface as far as their effects do.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from model.bundle import ShapeModel
from model.errors import InvalidParameter, UnknownMode
from model.geometry import Pose
from model.inference.mesh import Mesh, vertex_areas
from model.inference.posterior import CHUNK, normal_displacements
from model.inference.surface import require_spacing, surface_of

#: Scalars of a mesh along modes: outward movement (mm) for one more SD of the mode, and distance (mm) to the mean
#: surface, positive outside of it.
DISPLACEMENT, TO_MEAN = "displacement_mm_per_sd", "distance_to_mean_mm"
#: Farthest that a mode is followed (standard deviations).
FARTHEST_SD = 5.0
#: Vertices of the mean surface at which movements are measured, at most.
VERTICES = 384
#: A surface is looked for no farther than this (mm) from the mean one.
REACH_MM = 20.0
#: Shares of the variance for which active dimensions are counted (MorphoFlow paper).
VARIANCE_SHARES = (0.95, 0.97, 0.99)


@dataclass(frozen=True)
class Mode:
    """One dimension of the flow's base.

    Attributes:
        rank: by displacement, from 1.
        dimension: index in the latent code, from 0.
        sigma: standard deviation of the base.
        displacement_mm_per_sd: root mean square over the mean surface of its movement by one SD, both ways.
        variance_explained: share of the sum of all modes' mean squared displacements.
        cumulative_variance: sum of the shares up to this rank.
    """

    rank: int
    dimension: int
    sigma: float
    displacement_mm_per_sd: float
    variance_explained: float
    cumulative_variance: float


@dataclass(frozen=True)
class ShapeModes:
    """The modes of a model by rank, and its mean surface (canonical RAS mm)."""

    ranked: tuple[Mode, ...]
    mean: Mesh

    def mode(self, rank: int) -> Mode:
        """The mode of a rank.

        Raises:
            UnknownMode: there is none.
        """
        if not 1 <= rank <= len(self.ranked):
            raise UnknownMode(f"The model has no mode {rank}; ranks from 1 to {len(self.ranked)} are accepted.")
        return self.ranked[rank - 1]

    def active(self) -> tuple[int, int, int]:
        """How many modes, by rank, explain 95, 97 and 99 % of the surface's variance."""
        return active_counts(np.array([mode.cumulative_variance for mode in self.ranked]))


def active_counts(cumulative: Float[np.ndarray, "d"]) -> tuple[int, int, int]:
    """How many dimensions, largest first, hold each of `VARIANCE_SHARES`.

    Args:
        cumulative: share of the variance that each holds together with those before it.
    """
    low, middle, high = (int(np.searchsorted(cumulative, share - 1e-12)) + 1 for share in VARIANCE_SHARES)
    return low, middle, high


def shape_modes(model: ShapeModel) -> ShapeModes:
    """Modes ranked by what they move.

    Raises:
        InvalidParameter: the mean code has no surface.
    """
    latent = model.prior.from_base(np.zeros((1, model.manifest.latent_size)))[0]
    mean = surface_of(model, latent, Pose())
    _require_surface(mean, "mean")
    return ShapeModes(_ranked(_squares(model, latent, mean), np.asarray(model.manifest.sigmas)), mean)


def _squares(model: ShapeModel, latent: Float[np.ndarray, "d"], mean: Mesh) -> Float[np.ndarray, "d"]:
    """Mean squared movement (mm^2) of the mean surface to one SD along each dimension, both ways."""
    some = slice(None, None, -(-len(mean.vertices) // VERTICES))
    points, normals, areas = mean.vertices[some], mean.normals[some], vertex_areas(mean)[some]
    ends = np.concatenate([np.diag(way * np.asarray(model.manifest.sigmas)) for way in (1.0, -1.0)])
    _, by_point = model.decoder.logits_and_gradients(latent[None], points[None])
    slope = np.maximum(np.linalg.norm(by_point[0], axis=1), 1e-6)
    moves = _moves(model, model.prior.from_base(ends), points, normals, slope)
    squares = np.asarray(np.square(moves) @ areas / areas.sum())
    return np.asarray(squares.reshape(2, -1).mean(axis=0))


def _moves(
    model: ShapeModel,
    latents: Float[np.ndarray, "b d"],
    points: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    slope: Float[np.ndarray, "v"],
) -> Float[np.ndarray, "b v"]:
    """How far (mm) along a surface's normals those of other codes lie: a step by its slope, another by the secant."""
    start = _logits(model, latents, np.broadcast_to(points, (len(latents), *points.shape)))
    first = np.clip(start / slope, -REACH_MM, REACH_MM)
    rest = _logits(model, latents, points + first[..., None] * normals)
    fall = start - rest
    whole = np.divide(start, fall, out=np.ones_like(start), where=np.abs(fall) > 1e-9)
    return np.asarray(first * np.clip(whole, 0.5, 1.5))


def _logits(
    model: ShapeModel, latents: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b v 3"]
) -> Float[np.ndarray, "b v"]:
    return np.asarray(model.decoder.logits(latents, points), float)


def _ranked(squares: Float[np.ndarray, "d"], sigmas: Float[np.ndarray, "d"]) -> tuple[Mode, ...]:
    order = np.argsort(-squares, kind="stable")
    shares = squares[order] / max(float(squares.sum()), np.finfo(float).tiny)
    cumulative = np.minimum(np.cumsum(shares), 1.0)
    return tuple(
        Mode(rank, int(i), float(sigmas[i]), float(np.sqrt(squares[i])), float(shares[rank - 1]), float(total))
        for rank, (i, total) in enumerate(zip(order, cumulative, strict=True), start=1)
    )


def base_directions(model: ShapeModel, latent: Float[np.ndarray, "d"]) -> Float[np.ndarray, "d d"]:
    """Columns: movement of the latent code by one SD along each dimension of the base, at a code."""
    _, jacobian = model.prior.base_jacobian(latent[None])
    return np.asarray(np.linalg.inv(jacobian[0].astype(float)) * np.asarray(model.manifest.sigmas))


def displacements(
    model: ShapeModel,
    latent: Float[np.ndarray, "d"],
    points: Float[np.ndarray, "v 3"],
    directions: Float[np.ndarray, "d k"],
) -> Float[np.ndarray, "v k"]:
    """Outward movement (mm) of surface points for a step of the latent code along each direction, to first order."""
    parts = [np.zeros((0, directions.shape[1]))]
    for start in range(0, len(points), CHUNK):
        chunk = points[None, start : start + CHUNK]
        _, by_latent, by_point = model.decoder.logits_and_jacobians(latent[None], chunk)
        parts.append(normal_displacements(by_latent[0] @ directions, by_point[0]))
    return np.concatenate(parts)


def code_along(model: ShapeModel, modes: ShapeModes, coordinates: Mapping[int, float]) -> Float[np.ndarray, "d"]:
    """Latent code at coordinates (SD) along modes by rank, ``g^-1(sum_i sd_i sigma_i e_i)``.

    Raises:
        UnknownMode: no mode of a rank.
        InvalidParameter: a coordinate beyond 5 SD.
    """
    base = np.zeros(model.manifest.latent_size)
    for rank, sd in coordinates.items():
        mode = modes.mode(rank)
        if not abs(sd) <= FARTHEST_SD:
            raise InvalidParameter(
                f"Mode {rank} is asked for at {sd:g} SD; from -{FARTHEST_SD:g} to {FARTHEST_SD:g} is accepted.",
                part="sd",
            )
        base[mode.dimension] = sd * mode.sigma
    return np.asarray(model.prior.from_base(base[None])[0])


def shape_along(
    model: ShapeModel, modes: ShapeModes, coordinates: Mapping[int, float], spacing_mm: float | None = None
) -> Mesh:
    """Surface at coordinates (SD) along modes by rank, in the canonical frame.

    Its vertices carry the distance to the mean surface, and along a single mode the displacement by one more SD.

    Args:
        spacing_mm: grid step; the model's own when None.

    Raises:
        UnknownMode, InvalidParameter: see `code_along`; also when there is no surface that far out, or for a grid
            step outside 0.25 to 10 mm.
    """
    require_spacing(spacing_mm)
    latent = code_along(model, modes, coordinates)
    mesh = surface_of(model, latent, Pose(), spacing_mm)
    _require_surface(mesh, "sd")
    scalars = {TO_MEAN: distance_to_mean(modes.mean, mesh.vertices)}
    if len(coordinates) != 1:
        return mesh.with_scalars(**scalars)
    (rank,) = coordinates
    direction = base_directions(model, latent)[:, [modes.mode(rank).dimension]]
    return mesh.with_scalars(**{DISPLACEMENT: displacements(model, latent, mesh.vertices, direction)[:, 0], **scalars})


def distance_to_mean(mean: Mesh, points: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v"]:
    """Distance (mm) to the mean surface, positive outside: to the tangent plane at its nearest vertex."""
    _, nearest = cKDTree(mean.vertices).query(points)
    return np.asarray(np.sum((points - mean.vertices[nearest]) * mean.normals[nearest], axis=1), float)


def _require_surface(mesh: Mesh, part: str) -> None:
    if mesh.is_empty:
        raise InvalidParameter(
            "The model has no surface at this code; coordinates nearer to 0 are accepted.", part=part
        )
