"""The negative log posterior of latent code and pose, with gradient and Fisher curvature.

    E(z, pose) = lambda * sum_n w_n BCE(logit_n, y_n) + 1/2 |z0(z) / sigma|^2 - log p(pose)

over observations with weights ``w_n`` (mm^2 of annotated plane) and likelihood precision ``lambda`` (1/mm^2;
neighbouring voxels are not independent, so it is calibrated on validation shapes). Each evaluation gives logits with
their Jacobians by latent code and point; the pose's follow by the chain rule. The prior's mode is taken in the flow's
base coordinates ``z0 = g(z)``, where it is Gaussian: that makes it a sum of squares with Jacobian ``dz0/dz``, and the
whole a Gauss-Newton problem with curvature ``lambda w p (1 - p) J J^T`` plus ``(dz0/dz)^T diag(1/sigma^2) dz0/dz``
(Levenberg 1944, Marquardt 1963). The density's own mode in ``z`` would follow every ripple of the splines' determinant.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.special import expit

from model.backends import Prior
from model.bundle import ShapeModel
from model.geometry import POSE_SIZE, Pose
from model.inference.fit_types import FitOptions
from model.inference.observations import Observations

#: Latent codes (b, d) to base coordinates (b, d) and their Jacobian (b, d, d); see `model.backends.Prior`.
BaseJacobian = Callable[[Float[np.ndarray, "b d"]], tuple[Float[np.ndarray, "b d"], Float[np.ndarray, "b d d"]]]


@dataclass(frozen=True)
class LinearPrior:
    """A prior's base coordinates, linear around one code; good for small steps, and free of any network."""

    latent: Float[np.ndarray, "d"]
    base: Float[np.ndarray, "d"]
    slope: Float[np.ndarray, "d d"]

    @classmethod
    def around(cls, prior: Prior, latent: Float[np.ndarray, "d"]) -> "LinearPrior":
        """The prior's tangent at a code."""
        base, slope = prior.base_jacobian(latent[None])
        return cls(latent, base[0].astype(float), slope[0].astype(float))

    def base_jacobian(
        self, latent: Float[np.ndarray, "b d"]
    ) -> tuple[Float[np.ndarray, "b d"], Float[np.ndarray, "b d d"]]:
        """See `model.backends.Prior`."""
        return self.base + (latent - self.latent) @ self.slope.T, np.broadcast_to(
            self.slope, (len(latent), *self.slope.shape)
        )


@dataclass(frozen=True)
class Place:
    """Where the objective is evaluated."""

    latent: Float[np.ndarray, "d"]
    pose: Pose

    def moved(self, step: Float[np.ndarray, "p"]) -> "Place":
        """The place a step of (latent, pose step) away, see `Pose.moved`."""
        return Place(self.latent + step[:-POSE_SIZE], self.pose.moved(step[-POSE_SIZE:]))


@dataclass(frozen=True)
class Point:
    """The objective at one place, its gradient and Fisher curvature over (latent, pose step), and the prior's SDs."""

    latent: Float[np.ndarray, "d"]
    pose: Pose
    value: float
    gradient: Float[np.ndarray, "p"]
    curvature: Float[np.ndarray, "p p"]
    reach: Float[np.ndarray, "d"]


@dataclass(frozen=True)
class DataTerm:
    """What some observations add to the objective.

    Attributes:
        value: cross-entropy (nats).
        expected: what it would be on average if labels were drawn from the field: the entropy (nats).
        gradient, curvature: over (latent, pose step).
    """

    value: float
    expected: float
    gradient: Float[np.ndarray, "p"]
    curvature: Float[np.ndarray, "p p"]

    def times(self, share: float) -> "DataTerm":
        """The term of the same observations with other weights."""
        return DataTerm(share * self.value, share * self.expected, share * self.gradient, share * self.curvature)


class Objective:
    """The negative log posterior of one model, one set of observations and one starting pose."""

    def __init__(
        self,
        model: ShapeModel,
        observations: Observations,
        start: Pose,
        options: FitOptions,
        base_jacobian: BaseJacobian | None = None,
    ) -> None:
        self.model = model
        self.base_jacobian = base_jacobian or model.prior.base_jacobian
        self.points = observations.points
        self.labels = observations.labels
        self.weights = model.manifest.likelihood_precision * observations.weights
        self._plane_of = observations.plane_of
        self._plane_count = len(observations.planes)
        self._start = start
        self._pose_precision = 1.0 / np.square(
            [options.position_sd_mm] * 3 + [options.rotation_sd] * 3 + [options.log_scale_sd]
        )
        self._sigmas = np.asarray(model.manifest.sigmas)

    def at(self, latent: Float[np.ndarray, "d"], pose: Pose, sharpness: float = 1.0) -> Point:
        """Evaluate; logits are multiplied by `sharpness` (below 1 widens the basin of attraction)."""
        return evaluate([self], [Place(latent, pose)], sharpness)[0]

    def by_plane(self, place: Place) -> list[DataTerm]:
        """What each plane adds, in the order of the planes; nothing by a plane without observations."""
        logits, jacobian = (part[0] for part in _fields([self], [place]))
        terms = []
        for number in range(self._plane_count):
            rows = np.flatnonzero((self._plane_of == number) & (self.weights > 0))
            terms.append(_data_term(logits[rows], jacobian[rows], self.labels[rows], self.weights[rows]))
        return terms

    def gathered(self, place: Place, terms: Sequence[DataTerm]) -> Point:
        """What the terms of some planes make together with the priors."""
        data = DataTerm(
            sum(term.value for term in terms),
            sum(term.expected for term in terms),
            np.sum([term.gradient for term in terms], axis=0),
            np.sum([term.curvature for term in terms], axis=0),
        )
        base, by_latent = self.base_jacobian(place.latent[None])
        return self.point(place, data, base[0], by_latent[0])

    def point(
        self, place: Place, data: DataTerm, base: Float[np.ndarray, "d"], by_latent: Float[np.ndarray, "d d"]
    ) -> Point:
        """Data and priors together; `base` and `by_latent` are the code's base coordinates and their Jacobian."""
        whitened, slope = base.astype(float) / self._sigmas, by_latent.astype(float) / self._sigmas[:, None]
        offset = pose_offset(self._start, place.pose)
        pull = self._pose_precision * offset
        gradient = data.gradient + np.concatenate([slope.T @ whitened, pull])
        curvature = data.curvature + block_diag(slope.T @ slope, np.diag(self._pose_precision))
        value = data.value + 0.5 * float(whitened @ whitened) + 0.5 * float(pull @ offset)
        return Point(place.latent, place.pose, value, gradient, curvature, self._sigmas)


def evaluate(objectives: Sequence[Objective], places: Sequence[Place], sharpness: float = 1.0) -> list[Point]:
    """Several objectives of one model, each at a place of its own, in one batch; all have as many observations."""
    logits, jacobians = _fields(objectives, places)
    bases, slopes = objectives[0].base_jacobian(np.stack([place.latent for place in places]))
    points = []
    for number, (objective, place) in enumerate(zip(objectives, places, strict=True)):
        data = _data_term(
            sharpness * logits[number], jacobians[number], objective.labels, objective.weights, slope=sharpness
        )
        points.append(objective.point(place, data, bases[number], slopes[number]))
    return points


def _fields(
    objectives: Sequence[Objective], places: Sequence[Place]
) -> tuple[Float[np.ndarray, "b n"], list[Float[np.ndarray, "n p"]]]:
    """Logits and their derivatives by (latent, pose step) at each objective's observations."""
    canonical = np.stack([place.pose.to_canonical(one.points) for one, place in zip(objectives, places, strict=True)])
    latents = np.stack([place.latent for place in places])
    logits, by_latent, by_point = objectives[0].model.decoder.logits_and_jacobians(latents, canonical)
    jacobians = []
    for number, place in enumerate(places):
        by_pose = place.pose.jacobian(canonical[number], by_point[number]).astype(by_latent.dtype)
        jacobians.append(np.concatenate([by_latent[number], by_pose], axis=1))
    return logits.astype(float), jacobians


def _data_term(
    logits: Float[np.ndarray, "n"],
    jacobian: Float[np.ndarray, "n p"],
    labels: Float[np.ndarray, "n"],
    weights: Float[np.ndarray, "n"],
    slope: float = 1.0,
) -> DataTerm:
    """Weighted cross-entropy; `jacobian` is that of the logits before they were multiplied by `slope`."""
    probability = expit(logits)
    partition = np.logaddexp(0.0, logits)
    pull = slope * weights * (probability - labels)
    root = slope * np.sqrt(weights * probability * (1.0 - probability))
    scaled = jacobian * root.astype(jacobian.dtype)[:, None]
    return DataTerm(
        float(weights @ (partition - labels * logits)),
        float(weights @ (partition - probability * logits)),
        np.asarray(pull.astype(jacobian.dtype) @ jacobian, dtype=float),
        np.asarray(scaled.T @ scaled, dtype=float),
    )


def pose_offset(start: Pose, pose: Pose) -> Float[np.ndarray, "7"]:
    """The step that takes one pose to another (position mm, rotation vector rad, log scale)."""
    turn = Rotation.from_matrix(pose.rotation @ start.rotation.T).as_rotvec()
    return np.concatenate([pose.position - start.position, turn, [pose.log_scale - start.log_scale]])


def reweighted(observations: Observations, trust: Float[np.ndarray, "k"]) -> Observations:
    """The observations with each plane's weights multiplied by the trust in it."""
    return replace(observations, weights=observations.weights * trust[observations.plane_of])
