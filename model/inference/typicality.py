"""How like the population a shape is, as far as the model can tell: its code's density, and how well it was fitted.

A shape of another kind either needs a code that the prior holds for unlikely, or is one that no code expresses, so
that the contours stay far from it. Both are held against what answers to sound drawings of real shapes look like
(`Manifest.typical`): the code of a sparse drawing is drawn towards the middle of the population, and has another
density than one that was trained on a dense mask. How far a density lies below that of the mean shape is distributed
much like a chi square, whose cube root is nearly normal (Wilson and Hilferty 1931); so is the logarithm of a misfit. A
figure that is worse than usual by ``z`` SDs has the tail probability of Student's distribution, the predictive one for
estimates from few shapes. Both count together, by the sum of the squares of what is worse than usual (a chi-bar-square,
Kudo 1963; on sound drawings of hippocampi the two correlate by 0.05 to 0.08). More planes than were measured with take
the code farther from the middle than any sparse drawing would: then the misfit is judged alone.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.special import chdtrc, ndtri, stdtr

from model.bundle import ShapeModel
from model.inference.agreement import Section
from model.inference.fitting import Fit
from model.inference.mask_stack import Plane
from model.inference.reliability import MOST_USUAL_PLANES, Figures, usual_share

#: Below this percentile a shape is called unlike the population; below the other when it is by the density alone.
ATYPICAL_PERCENTILE, ATYPICAL_BY_DENSITY = 0.5, 1.0
#: Of a model that was not calibrated, and has fewer training codes, it is not said: few shapes are learned by heart,
#: and most others have codes less probable than any of theirs.
FEWEST_CODES = 50
#: A slice is told of when sound drawings would disagree as much with so small a probability.
SURPRISING = 1e-3
#: No tail is taken for less probable.
LEAST_TAIL = 1e-300


def peak_density(model: ShapeModel) -> float:
    """Log prior density (nats) of the code of the mean shape, ``z0 = 0``."""
    mean = model.prior.from_base(np.zeros((1, model.prior.latent_size)))
    return float(model.prior.log_density(mean)[0][0])


def rarity(densities: Float[np.ndarray, "n"], peak: float) -> Float[np.ndarray, "n"]:
    """Cube roots of how far log prior densities (nats) lie below the mean shape's."""
    return np.cbrt(np.maximum(peak - densities, 0.0))


def typicality(model: ShapeModel, found: Fit, figures: Figures) -> tuple[float, float]:
    """Log prior density of the fitted code (nats), and the percentile of the shape among real ones.

    Args:
        figures: of the fit; a misfit of 0 is one that was not looked at.
    """
    density = float(model.prior.log_density(found.latent[None])[0][0])
    known = model.manifest.typical
    if not known:
        return density, float(100.0 * np.mean(model.population.log_densities < density))
    deviation = misfit_deviation(known, found, figures)
    tails = [] if deviation is None else [_tail(known, deviation)]
    if figures.planes <= MOST_USUAL_PLANES or deviation is None:
        rare = float(rarity(np.array([density]), known["density_peak"])[0])
        tails.append(_tail(known, (rare - known["rarity_mean"]) / known["rarity_sd"]))
    return density, 100.0 * _joint_tail(tails)


def misfit_deviation(known: Mapping[str, float], found: Fit, figures: Figures) -> float | None:
    """By how many SDs the contours lie farther from a fit than those of sound drawings usually do.

    Args:
        known: `Manifest.typical`.

    Returns:
        None where the misfit was not looked at, or what is usual is not known.
    """
    misfit_mm = _trusting_misfit(found, figures)
    if not known or not misfit_mm > 0.0:
        return None
    usual = known["misfit_mean"] + known["misfit_exponent"] * np.log(usual_share(figures.planes))
    return float((np.log(misfit_mm) - usual) / known["misfit_sd"])


def typicality_warnings(model: ShapeModel, percentile: float) -> tuple[str, ...]:
    """What to tell about a shape that the model does not know."""
    is_calibrated = bool(model.manifest.typical)
    if not is_calibrated and len(model.population.log_densities) < FEWEST_CODES:
        return ()
    if percentile >= (ATYPICAL_PERCENTILE if is_calibrated else ATYPICAL_BY_DENSITY):
        return ()
    return ("The shape is unlike the population that the model was trained on; do not rely on it.",)


def predictive_probabilities(model: ShapeModel, sections: Sequence[Section]) -> list[float | None]:
    """For each plane, how probable it is that a sound drawing disagrees with its reconstruction at least as much.

    A posterior predictive check (Gelman, Meng and Stern 1996) of the cross-entropy of the labels relative to that of
    labels drawn from the field. Labels are not independent, so its distribution is that over sound drawings. None
    where the model does not know it. The more planes, the less a code can follow all of them: where there are more
    than were measured with, they are held against each other.
    """
    known = model.manifest.typical
    if not known:
        return [None for _ in sections]
    surprises = np.array([section.surprise for section in sections])
    usual, spread = known["slice_mean"], known["slice_sd"]
    if len(sections) > MOST_USUAL_PLANES:
        usual, spread = max(usual, float(np.median(surprises))), max(spread, float(surprises.std()))
    return [_tail(known, (surprise - usual) / spread) for surprise in surprises]


def predictive_warnings(
    sections: Sequence[Section], probabilities: Sequence[float | None], named: Sequence[Plane]
) -> tuple[str, ...]:
    """What to tell about planes whose drawing no draw from the posterior looks like, less those named elsewhere."""
    pairs = zip(sections, probabilities, strict=True)
    planes = [
        section.plane
        for section, value in pairs
        if value is not None and value < SURPRISING and section.trusted and section.plane not in named
    ]
    if not planes:
        return ()
    names = ", ".join(f"mask[{plane.stack}] axis {plane.axis} index {plane.index}" for plane in planes)
    sentence = (
        f"The drawing on {names} is not what the reconstruction would predict there, less so than in 999 of 1000 sound "
        "drawings: it contradicts the others, or the shape is unlike the population."
    )
    return (sentence,)


def _trusting_misfit(found: Fit, figures: Figures) -> float:
    """Misfit (mm) of the fit that trusts the drawing, as those were that it is held against; 0 when not looked at."""
    rough = found.full_trust_misfit_mm
    return figures.misfit_mm if rough is None or not figures.misfit_mm > 0.0 else rough


def _joint_tail(tails: Sequence[float]) -> float:
    """How probable figures are that are, together, at least as much worse than usual; one figure's tail is its own."""
    if len(tails) == 1:
        return tails[0]
    worse = float(np.square(np.maximum(-ndtri(np.maximum(tails, LEAST_TAIL)), 0.0)).sum())
    if worse == 0.0:
        return 1.0
    return float(0.5 * chdtrc(1, worse) + 0.25 * chdtrc(2, worse))


def _tail(known: Mapping[str, float], z: float) -> float:
    return float(stdtr(known["freedom"], -z))
