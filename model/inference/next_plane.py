"""Where to draw next: the plane that would reduce the expected uncertainty of the surface most.

To first order the posterior after a drawn plane has a covariance that does not depend on what will be drawn there
(Chaloner and Verdinelli, Bayesian experimental design, 1995), only on where its contour runs; the present surface says
that. A mm of contour tells code and pose ``lambda / g J J^T``: the Fisher information of its labels, which is
``lambda p (1 - p) J J^T`` a mm^2, summed over the band across the contour, in which the logit has slope ``g``. The
discrepancy is observed at the contour as it is at drawn ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from model.bundle import ShapeModel
from model.errors import InvalidParameter
from model.geometry import Grid
from model.inference.discrepancy.conditioning import CELL_MM
from model.inference.discrepancy.process import Discrepancy
from model.inference.fitting import Fit
from model.inference.mask_stack import Plane
from model.inference.mesh import Mesh, vertex_areas
from model.inference.posterior import fitted_jacobians, laplace_covariance
from model.inference.section_curves import (
    Cut,
    SectionCurve,
    free_cuts,
    grid_cuts,
    nearby_cuts,
    reached,
    section_curve,
)

Among = Literal["grid", "free"]

#: Vertices at which the SD is taken.
JUDGED_VERTICES = 250
#: Planes of the grid that are tried along an axis before the neighbours of the best one are.
PLANES_OF_AXIS = 16
#: Free planes: directions, places along each, and how far the best is then tilted (rad) and shifted.
DIRECTIONS, OFFSETS = 24, (0.3, 0.5, 0.7)
TILT, SHIFT = 0.2, 0.08
#: Points of all curves together, about; and how close they may be together (mm).
CURVE_POINTS, CLOSEST_MM = 1200, 2.0


@dataclass(frozen=True)
class NextPlane:
    """The plane to draw, and what it is expected to gain.

    Attributes:
        cut: the plane.
        surface_share: expected mean surface SD after it, as a share of the present one.
        volume_share: the same of the volume's SD.
        considered: how many planes were compared.
    """

    cut: Cut
    surface_share: float
    volume_share: float
    considered: int


def next_plane(
    model: ShapeModel, found: Fit, mesh: Mesh, grid: Grid, drawn: Sequence[Plane], among: Among = "grid"
) -> NextPlane:
    """The plane with the lowest expected mean surface SD.

    Args:
        found: the fit, with or without a discrepancy.
        mesh: its surface, world mm.
        grid: of the first stack; its planes along all three axes compete when `among` is ``grid``.
        drawn: planes that are drawn already.
        among: ``grid``, or ``free`` for planes of any orientation.

    Raises:
        InvalidParameter: every plane of the grid that cuts the surface is drawn.
    """
    judge = Judge(model, found, mesh)
    first = free_cuts(mesh, DIRECTIONS, OFFSETS) if among == "free" else _coarse_planes(mesh, grid, drawn)
    if not first:
        raise InvalidParameter(
            "Every plane of the input's grid that cuts the surface is drawn already; planes=free is accepted.",
            part="planes",
        )
    best = min(judge.judged(first), key=lambda one: one.surface_share)
    near = nearby_cuts(mesh, best.cut, TILT, SHIFT) if among == "free" else _neighbours(mesh, grid, drawn, best.cut)
    best = min([best, *judge.judged(near)], key=lambda one: one.surface_share)
    return NextPlane(_centred(mesh, best.cut), best.surface_share, best.volume_share, len(first) + len(near))


def _free_indices(mesh: Mesh, grid: Grid, drawn: Sequence[Plane], axis: int) -> list[int]:
    taken = {plane.index for plane in drawn if plane.stack == 0 and plane.axis == axis}
    return [index for index in reached(mesh, grid, axis) if index not in taken]


def _coarse_planes(mesh: Mesh, grid: Grid, drawn: Sequence[Plane]) -> list[Cut]:
    cuts: list[Cut] = []
    for axis in range(3):
        left = _free_indices(mesh, grid, drawn, axis)
        step = _stride(len(left))
        cuts += grid_cuts(mesh, grid, axis, left[(len(left) - 1) % step // 2 :: step])
    return cuts


def _stride(count: int) -> int:
    return max(1, -(-count // PLANES_OF_AXIS))


def _neighbours(mesh: Mesh, grid: Grid, drawn: Sequence[Plane], best: Cut) -> list[Cut]:
    """Planes between the best one and those that were tried beside it."""
    if best.plane is None:
        return []
    left = _free_indices(mesh, grid, drawn, best.plane.axis)
    reach = _stride(len(left))
    near = [index for index in left if 0 < abs(index - best.plane.index) < reach]
    return grid_cuts(mesh, grid, best.plane.axis, near[:: max(1, len(near) // PLANES_OF_AXIS)])


def _centred(mesh: Mesh, cut: Cut) -> Cut:
    curve = section_curve(mesh, cut, CLOSEST_MM)
    if not len(curve.lengths):
        return cut
    return Cut(curve.lengths @ curve.points / curve.lengths.sum(), cut.normal, cut.plane)


@dataclass(frozen=True)
class Judged:
    """A plane with the shares of the SDs that are expected to be left."""

    cut: Cut
    surface_share: float
    volume_share: float


@dataclass(frozen=True)
class _Places:
    """What the posterior knows at some points.

    Attributes:
        by_parameter: (m, p) derivatives of the model's logit.
        steepness: (m,) slope of that logit (1/mm).
        moved: (m, p) derivatives of the model's signed distance, saturated as the discrepancy sees it (mm).
        carried: (m, p) how far the process gives way (mm), see `Discrepancy.carried`.
        whitened: (n, m) covariances with the drawn contours, whitened by theirs.
        canonical: (m, 3) the points (mm).
    """

    by_parameter: Float[np.ndarray, "m p"]
    steepness: Float[np.ndarray, "m"]
    moved: Float[np.ndarray, "m p"]
    carried: Float[np.ndarray, "m p"]
    whitened: Float[np.ndarray, "n m"]
    canonical: Float[np.ndarray, "m 3"]

    def part(self, rows: slice) -> "_Places":
        """Some of the points."""
        return _Places(
            self.by_parameter[rows],
            self.steepness[rows],
            self.moved[rows],
            self.carried[rows],
            self.whitened[:, rows],
            self.canonical[rows],
        )


class Judge:
    """Expected SDs of one fit's surface and volume after planes that may be drawn."""

    def __init__(self, model: ShapeModel, found: Fit, mesh: Mesh) -> None:
        self._model, self._found, self._mesh = model, found, mesh
        self._covariance = laplace_covariance(found)
        step = max(1, len(mesh.vertices) // JUDGED_VERTICES)
        vertices = mesh.vertices[::step]
        self._areas = vertex_areas(mesh)[::step]
        _, _, by_point = fitted_jacobians(model, found, vertices)
        self._slope = np.maximum(np.linalg.norm(by_point, axis=1), 1e-6)
        self._surface = self._places(vertices)
        self._share = self._shrinkage(vertices)
        self._open = self._between(self._surface, self._surface)
        self._now = self._sds(self._covariance, self._surface.carried, self._open)

    def judged(self, cuts: Sequence[Cut]) -> list[Judged]:
        """The planes that cut the surface, judged."""
        spacing = CLOSEST_MM
        curves = [section_curve(self._mesh, cut, spacing) for cut in cuts]
        while sum(len(curve.lengths) for curve in curves) > CURVE_POINTS:
            spacing *= 1.3
            curves = [section_curve(self._mesh, cut, spacing) for cut in cuts]
        kept = [(cut, curve) for cut, curve in zip(cuts, curves, strict=True) if len(curve.lengths)]
        if not kept:
            return []
        places = self._places(np.concatenate([curve.points for _, curve in kept]))
        ends = np.cumsum([0] + [len(curve.lengths) for _, curve in kept])
        parts = [places.part(slice(a, b)) for a, b in pairwise(ends.tolist())]
        return [self._judged(cut, curve, part) for (cut, curve), part in zip(kept, parts, strict=True)]

    def _judged(self, cut: Cut, curve: SectionCurve, places: _Places) -> Judged:
        covariance = self._informed(curve, places)
        carried, left = self._surface.carried, self._open
        if self._found.discrepancy is not None:
            noise = self._found.discrepancy.noise_mm**2 * CELL_MM / np.maximum(curve.lengths, CELL_MM)
            gram = self._between(places, places) + np.diag(noise)
            across = self._between(places, self._surface)
            weights = cho_solve(cho_factor(gram.astype(float), lower=True), across.astype(float))
            left = left - across.T @ weights
            carried = carried + weights.T @ (places.moved - places.carried)
        surface, volume = self._sds(covariance, carried, left)
        return Judged(cut, surface / self._now[0], volume / self._now[1])

    def _informed(self, curve: SectionCurve, places: _Places) -> Float[np.ndarray, "p p"]:
        """Covariance of code and pose after the plane, by the matrix inversion lemma."""
        precision = self._found.trust * self._model.manifest.likelihood_precision
        worth = precision * curve.lengths / np.maximum(places.steepness, 1e-6)
        seen = np.sqrt(worth)[:, None] * places.by_parameter
        crossed = seen @ self._covariance
        gram = np.eye(len(seen)) + crossed @ seen.T
        return np.asarray(self._covariance - crossed.T @ np.linalg.solve(gram, crossed))

    def _sds(
        self, covariance: Float[np.ndarray, "p p"], carried: Float[np.ndarray, "v p"], left: Float[np.ndarray, "v v"]
    ) -> tuple[float, float]:
        """Mean SD of the surface (mm), and SD of the volume (mm^3)."""
        discrepancy = self._found.discrepancy
        moves = self._share[:, None] * self._surface.by_parameter
        reach = np.zeros(len(moves))
        if discrepancy is not None:
            moves = moves - discrepancy.slope * carried
            reach = discrepancy.slope / self._slope
        factors = moves / self._slope[:, None]
        variance = np.einsum("vp,vp->v", factors @ covariance, factors) + reach**2 * np.maximum(np.diag(left), 0.0)
        surface = float(self._areas @ np.sqrt(np.maximum(variance, 0.0)) / self._areas.sum())
        swept, opened = self._areas @ factors, self._areas * reach
        volume = float(swept @ covariance @ swept + opened @ left @ opened)
        return max(surface, 1e-9), max(np.sqrt(max(volume, 0.0)), 1e-9)

    def _shrinkage(self, vertices: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v"]:
        found = self._found
        if found.discrepancy is None:
            return np.ones(len(vertices))
        logits = self._model.decoder.logits(found.latent[None], found.pose.to_canonical(vertices)[None])[0]
        return found.discrepancy.shrinkage(logits)

    def _places(self, points: Float[np.ndarray, "m 3"]) -> _Places:
        found = self._found
        canonical = found.pose.to_canonical(points)
        logits, by_latent, by_point = (
            part[0] for part in self._model.decoder.logits_and_jacobians(found.latent[None], canonical[None])
        )
        by_parameter = np.concatenate([by_latent, found.pose.jacobian(canonical, by_point)], axis=1)
        steepness = np.linalg.norm(found.pose.gradient_to_world(by_point), axis=1)
        discrepancy = found.discrepancy
        if discrepancy is None:
            none = np.zeros_like(by_parameter)
            return _Places(by_parameter, steepness, none, none, np.zeros((0, len(points))), canonical)
        moved = by_parameter * discrepancy.levels.by_logit(logits)[:, None]
        return _Places(
            by_parameter,
            steepness,
            moved,
            discrepancy.carried(canonical),
            discrepancy.whitened(canonical),
            canonical,
        )

    def _between(self, a: _Places, b: _Places) -> Float[np.ndarray, "m n"]:
        """Covariance of the discrepancy between two sets of points (mm^2), given the drawn contours."""
        discrepancy: Discrepancy | None = self._found.discrepancy
        if discrepancy is None:
            return np.zeros((len(a.canonical), len(b.canonical)))
        return np.asarray(discrepancy.covariance.between(a.canonical, b.canonical) - a.whitened.T @ b.whitened)
