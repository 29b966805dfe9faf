"""Synthetic shapes from the prior."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from model.bundle import ShapeModel
from model.errors import InvalidParameter
from model.geometry import Pose
from model.inference.clusters import clusters_of, drawn_base
from model.inference.mesh import Mesh, largest_component
from model.inference.plausibility import counted, implausible
from model.inference.surface import require_spacing, surface_of

#: Accepted temperatures: above 0, at most this.
HIGHEST_TEMPERATURE = 2.0
#: A seed is drawn from at most so often; the last draw stands, plausible or not.
MAX_DRAWS = 16
#: Why a draw is rejected before its surface is known.
BETWEEN = "between_clusters"
#: Dimensions of a smaller sigma, against the largest, are dead: draws differ there from all training codes alike.
LEAST_SIGMA = 0.01


@dataclass(frozen=True)
class SampledShape:
    """One draw, in the model's canonical frame (RAS mm).

    Attributes:
        latent: (d,) latent code.
        log_density: of the latent code (nats).
        nearest_training_distance: distance in z0, in units of sigma, over live dimensions, to the nearest
            training code.
        mesh: its surface; of several components the one of largest volume.
        rejected: draws of the same seed before this one that were implausible or between clusters, by reason.
        plausible: whether this one is; None when it was not asked.
    """

    latent: Float[np.ndarray, "d"]
    log_density: float
    nearest_training_distance: float
    mesh: Mesh
    rejected: Mapping[str, int]
    plausible: bool | None


def draw_shape(
    model: ShapeModel,
    seed: int,
    *,
    temperature: float = 1.0,
    spacing_mm: float | None = None,
    reject: bool = True,
) -> SampledShape:
    """One shape, a pure function of (bundle, seed, temperature, spacing, reject).

    The draws of a seed are one stream of base codes; the first that lies where the training shapes are
    (`model.inference.clusters`) and is plausible (`model.inference.plausibility`) is the answer.

    Args:
        seed: non-negative.
        temperature: factor on the standard deviations of the base, in (0, 2].
        spacing_mm: grid step of the surface, 0.25 to 10; the model's own when None.
        reject: draw anew where a shape is implausible.

    Raises:
        InvalidParameter: an argument out of its range.
    """
    _check(seed, temperature, spacing_mm)
    sigmas = np.asarray(model.manifest.sigmas)
    stream = np.random.default_rng(seed)
    clusters = clusters_of(model.manifest) if reject else None
    reasons: list[str] = []
    for _ in range(MAX_DRAWS if reject else 1):
        base, thinned = drawn_base(sigmas, clusters, stream, temperature)
        reasons += [BETWEEN] * thinned
        latent = model.prior.from_base(base[None])[0]
        mesh = surface_of(model, latent, Pose(), spacing_mm, keep_specks=True)
        reason = implausible(model, mesh) if reject else None
        if reason is None:
            break
        reasons.append(reason)
    rejected = counted({name: 1} for name in (reasons[:-1] if reason else reasons))
    live = sigmas >= LEAST_SIGMA * sigmas.max()
    gap = np.linalg.norm(((model.population.base_codes - base) / sigmas)[:, live], axis=1)
    return SampledShape(
        latent=latent,
        log_density=float(model.prior.log_density(latent[None])[0][0]),
        nearest_training_distance=float(gap.min()),
        mesh=largest_component(mesh)[0],
        rejected=rejected,
        plausible=reason is None if reject else None,
    )


def _check(seed: int, temperature: float, spacing_mm: float | None) -> None:
    if seed < 0:
        raise InvalidParameter(f"seed is {seed}; a whole number from 0 is accepted.", part="seed")
    if not 0.0 < temperature <= HIGHEST_TEMPERATURE:
        raise InvalidParameter(
            f"temperature is {temperature:g}; above 0 and at most {HIGHEST_TEMPERATURE:g} is accepted.",
            part="temperature",
        )
    require_spacing(spacing_mm)
