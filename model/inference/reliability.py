"""Whether an answer is as accurate as the model's usually are, judged by what can be known without the truth.

Of the drawing itself: contours that the border of an image cuts off, and slices that are thick for the object. Of the
fit: how far the contours lie from the fitted shape before it follows them (misfit: noise of the annotator, planes that
contradict each other, a shape that the code cannot express) and how far the surface may lie elsewhere (mean posterior
SD: few planes, badly placed ones). Both are held against what sound drawings of as many planes give (`Manifest.usual`).
A drawing with a high misfit is trusted less: the fit goes on with a lower likelihood precision.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from model.bundle import ShapeModel
from model.inference.discrepancy.conditioning import DiscrepancyPrior, corrected
from model.inference.fitting import Fit, FitOptions, fit, refit, searched
from model.inference.mask_stack import MaskStack, Plane, section_of
from model.inference.mesh import Mesh, volume_ml
from model.inference.observations import Observations
from model.inference.posterior import (
    fitted_jacobians,
    laplace_covariance,
    logit_variance,
    normal_displacements,
    open_variance,
)
from model.inference.starts import has_few_planes
from model.inference.thick_slices import thickness_mm

#: Contours of which more than this share is open are called cut off: sound drawings of 16 validation shapes have none,
#: those that end at three quarters of the object 0.07 to 0.22.
OPEN_SHARE = 0.05
#: Slices thicker than this share of the object's size (cube root of its volume) hide some of its shape.
THICK_SHARE = 0.15
#: Number of planes that the figures in `Manifest.usual` are for, and the most that they were measured with.
USUAL_PLANES, MOST_USUAL_PLANES = 5, 8
#: Vertices at which the SD is taken, about.
JUDGED_VERTICES = 400
#: Share of the likelihood precision that is left to a rough drawing.
ROUGH_SHARE = 0.1


@dataclass(frozen=True)
class Figures:
    """What a fit says about itself.

    Attributes:
        planes: number of planes that it trusts.
        misfit_mm: RMS distance of the contours from the fitted shape, before that follows them; 0 when not looked at.
        surface_sd_mm: mean posterior SD of the surface.
    """

    planes: int
    misfit_mm: float
    surface_sd_mm: float


def reliability_warnings(
    usual: Mapping[str, float], figures: Figures, stacks: Sequence[MaskStack], planes: Sequence[Plane], mesh: Mesh
) -> tuple[str, ...]:
    """What to tell about drawings and fits that are worse than usual for the model."""
    thick = thickness_warnings(stacks, planes, mesh)
    # Contours of thick slices stand where the slice's average crosses one half, off the shape's own sections.
    unusual = unusual_warnings(usual, replace(figures, misfit_mm=0.0) if thick else figures)
    return open_warnings(stacks, planes) + thick + unusual


def figures_of(
    model: ShapeModel,
    found: Fit,
    stacks: Sequence[MaskStack],
    observations: Observations,
    mesh: Mesh,
    prior: DiscrepancyPrior,
    sd_mm: Float[np.ndarray, "v"] | None = None,
) -> Figures:
    """Figures of a fit under the model's own discrepancy, whatever fidelity the caller asked for.

    Args:
        sd_mm: posterior SD of each vertex by the fit itself, where it is known.
    """
    step = max(1, len(mesh.vertices) // JUDGED_VERTICES)
    judged = corrected(model, found, stacks, observations, prior)
    if sd_mm is None or judged is not found:
        spread = _mean_sd(model, judged, mesh.vertices[::step])
    else:
        spread = float(sd_mm[::step].mean())
    return Figures(_planes_used(found, observations), _misfit(model, judged), spread)


def less_trusting(
    model: ShapeModel,
    found: Fit,
    stacks: Sequence[MaskStack],
    observations: Observations,
    options: FitOptions,
    prior: DiscrepancyPrior,
) -> tuple[ShapeModel, Fit]:
    """Model and fit with less trust in the drawing when that is rough, otherwise as they are.

    First a better place and a single plane that is to blame are looked for, more thoroughly than in any fit. Drawings
    on thick slices are not judged. Fits are judged by their codes' shapes, so no drawing is completed on the way; a
    good one comes back with its discrepancy where nothing completes it.
    """
    if any(thickness_mm(stacks[plane.stack], plane) for plane in observations.planes):
        return model, found
    alone = replace(model, completer=None)
    for tried in _ever_harder(model, observations, found, options):
        judged = corrected(alone, tried, stacks, observations, prior)
        if not _is_rough(model, judged, observations):
            return model, judged if model.completer is None else tried
    lower = ROUGH_SHARE * model.manifest.likelihood_precision
    doubting = replace(model, manifest=replace(model.manifest, likelihood_precision=lower))
    doubted = refit(doubting, observations, tried, options)
    return doubting, replace(doubted, trust=ROUGH_SHARE, full_trust_misfit_mm=_misfit(model, judged))


def _ever_harder(model: ShapeModel, observations: Observations, found: Fit, options: FitOptions) -> Iterator[Fit]:
    """The fit, then better ones as long as they are asked for: from screened starts, and without a wrong plane."""
    yield found
    if not has_few_planes(observations):
        screened = fit(model, observations, replace(options, screened=True))
        if _standing(screened) < _standing(found):
            found = screened
            yield found
    yield searched(model, observations, found, options)


def _standing(found: Fit) -> tuple[int, float]:
    """Planes that a fit leaves out, and its objective on the others (nats): of two fits the lower one is better."""
    return 0 if found.plane_weights is None else int((found.plane_weights == 0).sum()), found.objective


def _is_rough(model: ShapeModel, judged: Fit, observations: Observations) -> bool:
    return _misfit(model, judged) > highest_usual(model.manifest.usual, "misfit", _planes_used(judged, observations))


def _planes_used(found: Fit, observations: Observations) -> int:
    used = observations.weights > 0
    if found.plane_weights is not None:
        used &= found.plane_weights[observations.plane_of] > 0
    return len(np.unique(observations.plane_of[used]))


def _misfit(model: ShapeModel, found: Fit) -> float:
    """RMS distance (mm) of the drawn contours from the code's shape, whatever a network makes of the drawing."""
    seen = found.discrepancy
    if seen is None:
        return 0.0
    residuals = seen.residuals
    if seen.levels.completion is not None:
        logits = model.decoder.logits(found.latent[None], seen.points[None])[0]
        residuals = residuals + seen.levels.at(logits, seen.points) - seen.levels.of_code(logits)
    return float(np.sqrt(np.mean(np.square(residuals))))


def _mean_sd(model: ShapeModel, found: Fit, points: Float[np.ndarray, "v 3"]) -> float:
    """Mean posterior SD (mm) of surface points along their normals."""
    _, by_parameter, by_point = fitted_jacobians(model, found, points)
    variance = logit_variance(by_parameter, laplace_covariance(found)) + open_variance(found, points)
    return float(normal_displacements(np.sqrt(variance)[:, None], by_point).mean())


def highest_usual(usual: Mapping[str, float], name: str, planes: int) -> float:
    """Highest usual value of a figure (mm) with so many planes; infinite for a model that does not say."""
    if f"{name}_mm" not in usual:
        return float("inf")
    return float(usual[f"{name}_mm"] * usual_share(planes) ** usual[f"{name}_exponent"])


def usual_share(planes: int) -> float:
    """A number of planes by `USUAL_PLANES`; more than were measured with are judged like the most."""
    return min(planes, MOST_USUAL_PLANES) / USUAL_PLANES


def unusual_warnings(usual: Mapping[str, float], figures: Figures) -> tuple[str, ...]:
    """What to tell of a figure that is higher than usual: the misfit first, for it is a reason of the other."""
    misfit, spread = (highest_usual(usual, name, figures.planes) for name in ("misfit", "surface_sd"))
    if figures.misfit_mm > misfit:
        sentence = (
            f"The drawn contours lie {figures.misfit_mm:.2f} mm (RMS) from the fitted shape, where up to "
            f"{misfit:.2f} mm is usual; the drawing is rough or contradicts itself, do not rely on details."
        )
        return (sentence,)
    if figures.surface_sd_mm > spread:
        sentence = (
            f"The drawing leaves the surface uncertain by {figures.surface_sd_mm:.2f} mm on average, where up to "
            f"{spread:.2f} mm is usual with as many planes; do not rely on it away from them."
        )
        return (sentence,)
    return ()


def open_share(stacks: Sequence[MaskStack], planes: Sequence[Plane]) -> float:
    """Share of the drawn contours' length that runs along the border of an image or of what was looked at."""
    lengths = np.array([_contour_lengths(stacks[plane.stack], plane) for plane in planes]).reshape(-1, 2).sum(axis=0)
    return float(lengths[1] / lengths.sum()) if lengths.any() else 0.0


def open_warnings(stacks: Sequence[MaskStack], planes: Sequence[Plane]) -> tuple[str, ...]:
    """What to tell when images end inside the object."""
    share = open_share(stacks, planes)
    if share <= OPEN_SHARE:
        return ()
    sentence = (
        f"About {100 * share:.0f} % of the drawn contours is open, cut off by the border of an image; do not rely on "
        "the surface beyond."
    )
    return (sentence,)


def _contour_lengths(stack: MaskStack, plane: Plane) -> tuple[float, float]:
    """Length (mm) of a section's contour that is closed, and that is open."""
    inside = np.pad(section_of(stack.foreground, plane), 1)
    seen = np.pad(~section_of(stack.excluded, plane), 1)
    closed, open_ = 0.0, 0.0
    for axis, step in enumerate(np.delete(stack.grid.spacing, plane.axis)[::-1]):
        (a, b), (seen_a, seen_b) = _neighbours(inside & seen, axis), _neighbours(seen, axis)
        closed += float(step * ((a != b) & seen_a & seen_b).sum())
        open_ += float(step * ((a & ~seen_b) | (b & ~seen_a)).sum())
    return closed, open_


def _neighbours(values: Bool[np.ndarray, "a b"], axis: int) -> tuple[Bool[np.ndarray, "c d"], Bool[np.ndarray, "c d"]]:
    along = np.moveaxis(values, axis, 0)
    return along[:-1], along[1:]


def thickness_warnings(stacks: Sequence[MaskStack], planes: Sequence[Plane], mesh: Mesh) -> tuple[str, ...]:
    """What to tell when most slices are thick for the object."""
    size = float(np.cbrt(1000.0 * volume_ml(mesh)))
    thickness = np.array([thickness_mm(stacks[plane.stack], plane) for plane in planes])
    if np.median(thickness) <= THICK_SHARE * size:
        return ()
    sentence = (
        f"Slices are {np.median(thickness):.1f} mm thick, much compared with the object; what changes within a slice "
        "was not seen. Do not rely on details, nor on the intervals."
    )
    return (sentence,)
