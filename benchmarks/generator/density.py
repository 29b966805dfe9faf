"""Log densities of codes that were not trained on, under the flow and under a Gaussian on the same codes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.stats import multivariate_normal

from benchmarks.generator.surfaces import Surface, surface_from
from model.bundle import ShapeModel
from model.geometry import Pose
from model.inference.mask_stack import MaskStack
from model.inference.reconstruction import Options, reconstruct
from model.inference.surface import surface_of
from training.cohorts.cohort import Case


@dataclass(frozen=True)
class FittedCase:
    """A dense mask as the model describes it: its code, and that code's surface in its own centroid's frame."""

    latent: Float[np.ndarray, "d"]
    surface: Surface


def fitted(model: ShapeModel, case: Case, spacing_mm: float) -> FittedCase:
    """Fit a dense mask, every plane of it drawn; training and held-out cases are fitted alike."""
    stack = MaskStack("mask[0]", case.grid, case.mask, np.zeros_like(case.mask))
    options = Options(annotated="all", uncertainty="none", resolution_mm=spacing_mm, fidelity=0.0)
    fit = reconstruct(model, (stack,), options).state.fits[0]
    pose = Pose(np.zeros(3), fit.pose.rotation, fit.pose.log_scale, fit.pose.mirrored)
    return FittedCase(np.asarray(fit.latent, float), surface_from(surface_of(model, fit.latent, pose, spacing_mm)))


@dataclass(frozen=True)
class GaussianPrior:
    """A Gaussian on latent codes, its covariance shrunk towards a multiple of the identity (OAS, Chen et al. 2010)."""

    mean: Float[np.ndarray, "d"]
    covariance: Float[np.ndarray, "d d"]

    @classmethod
    def of(cls, codes: Float[np.ndarray, "m d"]) -> "GaussianPrior":
        """Mean and shrunk covariance of codes."""
        count, size = codes.shape
        sample = np.cov(codes.T, bias=True)
        trace, square = float(np.trace(sample)), float(np.sum(sample**2))
        top = (1.0 - 2.0 / size) * square + trace**2
        share = min(1.0, top / max((count + 1.0 - 2.0 / size) * (square - trace**2 / size), 1e-300))
        return cls(codes.mean(axis=0), (1.0 - share) * sample + share * trace / size * np.eye(size))

    def log_density(self, codes: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m"]:
        """Nats."""
        return np.asarray(multivariate_normal.logpdf(codes, self.mean, self.covariance)).reshape(-1)

    def draw(self, count: int, seed: int) -> Float[np.ndarray, "m d"]:
        """Codes."""
        return np.random.default_rng(seed).multivariate_normal(self.mean, self.covariance, count)


def log_densities(model: ShapeModel, cases: Sequence[FittedCase]) -> Float[np.ndarray, "m"]:
    """``log p(z)`` of fitted codes (nats)."""
    return np.concatenate([model.prior.log_density(case.latent[None])[0] for case in cases]).astype(float)
