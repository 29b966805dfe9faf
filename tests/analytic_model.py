"""A shape model with exact answers: ellipsoids whose log semi-axes are standard normal.

It stands in for a trained bundle wherever a test is about what surrounds the model.
"""

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from model.bundle import Manifest, Population, ShapeModel

#: Semi-axes (mm) of the mean shape.
MEAN_AXES = (12.0, 9.0, 7.0)
#: Standard deviation of each log semi-axis.
SPREAD = 0.15
#: Slope of the logits: nats over one semi-axis.
STEEPNESS = 40.0


@dataclass(frozen=True)
class EllipsoidDecoder:
    """``logit = k (1 - |u / a|)`` with semi-axes ``a = mean exp(spread z)``, at the origin along the axes."""

    mean_axes: tuple[float, float, float] = MEAN_AXES
    latent_size: int = 3

    def axes(self, latent: Float[np.ndarray, "b 3"]) -> Float[np.ndarray, "b 3"]:
        """Semi-axes (mm) of latent codes."""
        return np.array(self.mean_axes) * np.exp(SPREAD * latent)

    def logits(self, latent: Float[np.ndarray, "b 3"], points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n"]:
        """Positive inside."""
        return STEEPNESS * (1.0 - np.linalg.norm(points / self.axes(latent)[:, None], axis=-1))

    def logits_and_jacobians(
        self, latent: Float[np.ndarray, "b 3"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n 3"], Float[np.ndarray, "b n 3"]]:
        """The same with derivatives by latent code and by point (per mm)."""
        axes = self.axes(latent)[:, None]
        scaled = points / axes
        radius = np.maximum(np.linalg.norm(scaled, axis=-1, keepdims=True), 1e-9)
        by_latent = STEEPNESS * SPREAD * scaled**2 / radius
        by_point = -STEEPNESS * scaled / axes / radius
        return STEEPNESS * (1.0 - radius[..., 0]), by_latent, by_point

    def logits_and_gradients(
        self, latent: Float[np.ndarray, "b 3"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n 3"]]:
        """The same with derivatives by point alone."""
        logits, _, by_point = self.logits_and_jacobians(latent, points)
        return logits, by_point


@dataclass(frozen=True)
class BentDecoder(EllipsoidDecoder):
    """The same ellipsoids, bent along the curve ``(t, -p t^2, -q t^3)``: chiral, and of unchanged volume.

    ``(x, y, z) -> (x, y + p x^2, z + q x^3)`` takes a bent shape back to the ellipsoid; its determinant is 1.
    """

    bend: float = 0.03
    twist: float = 0.003

    def logits(self, latent: Float[np.ndarray, "b 3"], points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n"]:
        """Positive inside."""
        return super().logits(latent, self._straight(points))

    def logits_and_jacobians(
        self, latent: Float[np.ndarray, "b 3"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n 3"], Float[np.ndarray, "b n 3"]]:
        """The same with derivatives by latent code and by point (per mm)."""
        logits, by_latent, by_point = super().logits_and_jacobians(latent, self._straight(points))
        x = points[..., 0]
        along = by_point[..., 0] + 2.0 * self.bend * x * by_point[..., 1] + 3.0 * self.twist * x**2 * by_point[..., 2]
        return logits, by_latent, np.concatenate([along[..., None], by_point[..., 1:]], axis=-1)

    def _straight(self, points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n 3"]:
        x, y, z = np.moveaxis(points, -1, 0)
        return np.stack([x, y + self.bend * x**2, z + self.twist * x**3], axis=-1)


@dataclass(frozen=True)
class StandardNormalPrior:
    """``z ~ N(0, I)``; its flow is the identity."""

    latent_size: int = 3

    def log_density(self, latent: Float[np.ndarray, "b d"]) -> tuple[Float[np.ndarray, "b"], Float[np.ndarray, "b d"]]:
        """Nats, and the gradient."""
        constant = 0.5 * self.latent_size * np.log(2.0 * np.pi)
        return -0.5 * np.sum(latent**2, axis=1) - constant, -latent

    def to_base(self, latent: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
        """The code itself."""
        return latent

    def base_jacobian(
        self, latent: Float[np.ndarray, "b d"]
    ) -> tuple[Float[np.ndarray, "b d"], Float[np.ndarray, "b d d"]]:
        """The code itself, and the identity."""
        return latent, np.broadcast_to(np.eye(self.latent_size), (len(latent), self.latent_size, self.latent_size))

    def from_base(self, base: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
        """The code itself."""
        return base


def ellipsoid_model(name: str = "ellipsoid", mean_axes: tuple[float, float, float] = MEAN_AXES) -> ShapeModel:
    """The family as an opened model, with a population drawn from it."""
    decoder, prior = EllipsoidDecoder(mean_axes), StandardNormalPrior()
    codes = np.random.default_rng(5).normal(size=(64, 3))
    volumes = 4.0 / 3.0 * np.pi * np.prod(decoder.axes(codes), axis=1) / 1000.0
    population = Population(codes, codes, prior.log_density(codes)[0], volumes)
    digest = hashlib.sha256(f"{name} {mean_axes}".encode()).hexdigest()
    return ShapeModel(_manifest(name, mean_axes), digest, population, decoder, prior)


def bent_model() -> ShapeModel:
    """The bent family: its shapes differ from their mirror images however they are turned."""
    return replace(ellipsoid_model("bent"), decoder=BentDecoder())


def _manifest(name: str, mean_axes: tuple[float, float, float]) -> Manifest:
    first, second, third = (1.8 * axis for axis in mean_axes)
    return Manifest(
        name=name,
        version="1.0.0",
        structure="ellipsoid",
        frame="RAS",
        units="mm",
        side="unpaired",
        latent_size=3,
        sigmas=(1.0, 1.0, 1.0),
        active_dimensions=(3, 3, 3),
        half_extent_mm=(first, second, third),
        resolution_mm=1.0,
        likelihood_precision=1.0,
        calibration={},
        training={"cohort": "analytic"},
        licence="CC0-1.0",
        attribution="none",
        accuracy={"thin": {"dice": 1.0}},
        files={},
    )
