"""The discrepancy of one fit: where its surface misses the drawn contours, and by how much."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from model.bundle import Manifest, ShapeModel
from model.inference.completion.completing import completed
from model.inference.discrepancy.contours import contour_points
from model.inference.discrepancy.covariance import Covariance
from model.inference.discrepancy.grouping import cells_of, means_of, middle_of
from model.inference.discrepancy.levels import Levels, saturated
from model.inference.discrepancy.process import Discrepancy
from model.inference.fitting import Fit
from model.inference.mask_stack import MaskStack
from model.inference.objective import Place
from model.inference.observations import Observations
from model.inference.posterior import model_logits
from model.inference.surface import canonical_box
from model.inference.thick_slices import Columns, columns_of, decided

#: Points of a contour this close together (mm) are taken together.
CELL_MM = 1.5
#: Of more than this many, evenly spread ones are taken, this far (mm) apart or farther; means over larger cells would
#: lie inside the object.
MOST_POINTS, CLOSEST_MM = 900, 0.3
#: Observations on the wrong side of the fitted surface count when they are farther than this from a contour (mm).
CLEARLY_WRONG_MM = 1.5
#: Planes are kept this far apart (mm) when distances within them are looked up.
APART_MM = 1e4
#: SD of the observations that no fidelity goes below (mm): half a voxel's quantisation.
LEAST_NOISE_MM = 0.1


@dataclass(frozen=True)
class DiscrepancyPrior:
    """What is expected of a model's residuals, before a drawing is seen.

    Attributes:
        spread_mm: SD of the residual at contour points.
        fidelity: share of its variance that is the shape's and not the annotator's: 0 trusts the model alone, 1 the
            drawing alone.
        lengths_mm: of the covariance's terms, which have equal shares.
    """

    spread_mm: float = 0.6
    fidelity: float = 0.5
    lengths_mm: tuple[float, ...] = (2.0, 8.0)

    @property
    def covariance(self) -> Covariance:
        """Of the shape's part."""
        sd = self.spread_mm * float(np.sqrt(self.fidelity / len(self.lengths_mm)))
        return Covariance((sd,) * len(self.lengths_mm), self.lengths_mm)

    @property
    def noise_mm(self) -> float:
        """SD of the annotator's part."""
        return max(LEAST_NOISE_MM, self.spread_mm * float(np.sqrt(1.0 - self.fidelity)))


def discrepancy_prior(manifest: Manifest, fidelity: float | None = None) -> DiscrepancyPrior:
    """The one calibrated for a model, with another fidelity when it is given."""
    known = manifest.discrepancy
    prior = DiscrepancyPrior() if not known else DiscrepancyPrior(known["spread_mm"], known["fidelity"])
    return prior if fidelity is None else replace(prior, fidelity=fidelity)


def with_discrepancy(
    model: ShapeModel, found: Fit, stacks: Sequence[MaskStack], observations: Observations, prior: DiscrepancyPrior
) -> Fit:
    """The fit with its discrepancy, see `discrepancy_of`."""
    return replace(found, discrepancy=discrepancy_of(model, found, stacks, observations, prior))


def corrected(
    model: ShapeModel, found: Fit, stacks: Sequence[MaskStack], observations: Observations, prior: DiscrepancyPrior
) -> Fit:
    """The fit with its discrepancy under a prior; what it has observed already is not observed again."""
    made = found.discrepancy
    if made is None:
        return with_discrepancy(model, found, stacks, observations, prior)
    if prior.fidelity <= 0.0:
        return replace(found, discrepancy=None)
    if (made.covariance, made.noise_mm) == (prior.covariance, prior.noise_mm):
        return found
    return replace(found, discrepancy=replace(made, covariance=prior.covariance, noise_mm=prior.noise_mm))


def discrepancy_of(
    model: ShapeModel, found: Fit, stacks: Sequence[MaskStack], observations: Observations, prior: DiscrepancyPrior
) -> Discrepancy | None:
    """The discrepancy given the drawn contours; None where the model alone is trusted or nothing was drawn.

    Observed are contour points (the surface runs there) and observations far on the wrong side of the fitted surface
    (it is elsewhere). On a thick slice that is told of the level that decides whether half of the thickness is filled
    (`model.inference.thick_slices`). Planes that the fit left out are left out.
    """
    if prior.fidelity <= 0.0:
        return None
    seen = _within(_evidence(model, found, stacks, observations), found, canonical_box(model))
    if not len(seen.distances):
        return None
    canonical = found.pose.to_canonical(seen.points)
    logits, by_latent, by_point = (
        part[0] for part in model.decoder.logits_and_jacobians(found.latent[None], canonical[None])
    )
    slope = float(np.median(np.linalg.norm(by_point, axis=1)))
    levels = Levels(slope, completed(model, found, stacks, observations, slope))
    level = _told_of(model, found, levels, seen, levels.at(logits, canonical))
    by_parameter = np.concatenate([by_latent, found.pose.jacobian(canonical, by_point)], axis=1)
    return Discrepancy(
        points=canonical,
        residuals=saturated(seen.distances * np.exp(found.pose.log_scale)) - level,
        jacobian=by_parameter * levels.by_logit(logits)[:, None],
        covariance=prior.covariance,
        noise_mm=prior.noise_mm,
        levels=levels,
        half_extent=canonical_box(model),
    )


def observed_anew(model: ShapeModel, found: Fit, places: Sequence[Place]) -> list[Discrepancy | None]:
    """The fit's discrepancy as it is from each of other codes and poses, which the same contours hold; None without."""
    made = found.discrepancy
    if made is None or not places:
        return [None for _ in places]
    world = found.pose.to_world(made.points)
    points = np.stack([made.points, *(place.pose.to_canonical(world) for place in places)])
    logits = model.decoder.logits(np.stack([found.latent, *(place.latent for place in places)]), points)
    levels = [made.levels.at(row, there) for row, there in zip(logits, points, strict=True)]
    return [
        replace(made, points=there, residuals=made.residuals + levels[0] - level)
        for there, level in zip(points[1:], levels[1:], strict=True)
    ]


@dataclass(frozen=True)
class _Evidence:
    """Points (world mm) and what is known of each.

    Attributes:
        distances: signed, from the drawn contour (world mm, positive inside; 0 on it).
        columns: what is averaged there.
    """

    points: Float[np.ndarray, "n 3"]
    distances: Float[np.ndarray, "n"]
    columns: Columns

    def __getitem__(self, chosen: Int[np.ndarray, "m"] | Bool[np.ndarray, "n"]) -> "_Evidence":
        return _Evidence(self.points[chosen], self.distances[chosen], self.columns[chosen])


def _within(evidence: _Evidence, found: Fit, half: Float[np.ndarray, "3"]) -> _Evidence:
    return evidence[(np.abs(found.pose.to_canonical(evidence.points)) <= half).all(axis=1)]


def _told_of(
    model: ShapeModel, found: Fit, levels: Levels, seen: _Evidence, at_centres: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Distance from the fitted surface (mm) that is observed at each point: that there, on thin slices."""
    thick = seen.columns.counts > 1
    if not thick.any():
        return at_centres

    def level(points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m"]:
        return levels.at(model_logits(model, found, points), found.pose.to_canonical(points))

    result = at_centres.copy()
    _, result[thick] = decided(level, seen.points[thick], seen.columns[thick])
    return result


def _evidence(model: ShapeModel, found: Fit, stacks: Sequence[MaskStack], observations: Observations) -> _Evidence:
    """Contour points, at distance 0, and what lies clearly on the wrong side, both thinned out."""
    trusted = np.ones(len(observations.planes), bool) if found.plane_weights is None else found.plane_weights > 0
    contour, plane_of = contour_points(stacks, observations.planes)
    used = trusted[plane_of]
    contour, plane_of = contour[used], plane_of[used]
    wrong, distances = _wrong_side(model, found, observations, trusted, contour, plane_of)
    columns = columns_of(stacks, observations.planes, found.thick_rule)
    whole = _Evidence(
        np.concatenate([contour, observations.points[wrong]]),
        np.concatenate([np.zeros(len(contour)), distances]),
        columns[np.concatenate([plane_of, observations.plane_of[wrong]])],
    )
    if not len(whole.points):
        return whole
    kinds = np.concatenate([plane_of + 1, np.zeros(len(wrong), int)])
    cells = cells_of(found.pose.to_canonical(whole.points), CELL_MM, kinds)
    means = _Evidence(
        means_of(cells, whole.points),
        means_of(cells, whole.distances[:, None])[:, 0],
        Columns(
            means_of(cells, whole.columns.vectors),
            means_of(cells, whole.columns.widths_mm[:, None])[:, 0],
            found.thick_rule,
        ),
    )
    return means[_spread_out(found.pose.to_canonical(means.points), means.distances != 0.0)]


def _wrong_side(
    model: ShapeModel,
    found: Fit,
    observations: Observations,
    trusted: Bool[np.ndarray, "k"],
    contour: Float[np.ndarray, "n 3"],
    plane_of: Int[np.ndarray, "n"],
) -> tuple[Int[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Numbers of observations that the fit has clearly on the wrong side of its surface.

    Returns:
        The numbers, and signed distances from the drawn contour in the plane (world mm, positive inside).
    """
    inside = observations.labels > 0
    wrong = np.flatnonzero(
        ((model_logits(model, found, observations.points) > 0) != inside) & trusted[observations.plane_of]
    )
    if not (wrong.size and len(contour)):
        return np.zeros(0, int), np.zeros(0)
    apart = APART_MM * plane_of[:, None], APART_MM * observations.plane_of[wrong][:, None]
    tree = cKDTree(np.hstack([contour, apart[0]]))
    distance = np.asarray(tree.query(np.hstack([observations.points[wrong], apart[1]]))[0])
    clear = (distance > CLEARLY_WRONG_MM) & (distance < APART_MM)
    chosen = wrong[clear]
    return chosen, np.where(inside[chosen], distance[clear], -distance[clear])


def _spread_out(points: Float[np.ndarray, "n 3"], kinds: Bool[np.ndarray, "n"]) -> Int[np.ndarray, "m"]:
    """Points (canonical mm) of both kinds that are left of too many, one of each cell."""
    if len(points) <= MOST_POINTS:
        return np.arange(len(points))
    size = CLOSEST_MM
    while True:
        cells = cells_of(points, size, kinds.astype(int))
        if cells.max() < MOST_POINTS:
            return middle_of(cells, points)
        size *= 1.15
