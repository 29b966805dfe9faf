"""Whether a drawing is of the other side: its mirror image is a shape of the population, and it is none.

An image whose left and right were exchanged on the way, or a left organ sent to a model of right ones, comes back as a
smooth surface that looks like an answer. So where a drawing is fitted worse than most, its mirror image is fitted too.
The model as likely holds for either side; how much lower the objective is on the other one (nats) is then the log of
the posterior odds. Populations that hold both sides, and symmetric shapes, have as good a fit on either.
"""

from typing import cast

import numpy as np

from model.bundle import ShapeModel
from model.inference.fit_types import Fit, FitOptions, MirrorRule
from model.inference.fitting import fit
from model.inference.observations import Observations
from model.inference.reliability import Figures
from model.inference.typicality import misfit_deviation

#: The mirror image is fitted where the misfit is so many SDs worse than that of sound drawings on average: of
#: validation shapes, a third of their own drawings and all of mirrored ones (hippocampus).
LOOKED_AT = 0.5
#: Mirror images that are better by more than this (nats) are told of.
FAR_BETTER_NATS = 10.0


def nats_of_other_side(
    model: ShapeModel, observations: Observations, found: Fit, figures: Figures, mirror: MirrorRule
) -> float:
    """How much better (nats) the mirror image explains a drawing; 0 where it does not, and where it was not looked at.

    It is not looked at where the fit may choose its side, and where the drawing is fitted well.

    Args:
        model: as it is, with all of its trust in the drawing.
        observations: that the fit trusts.
        figures: of the fit; a misfit of 0 is one that was not looked at.
    """
    deviation = misfit_deviation(model.manifest.typical, found, figures)
    if mirror == "auto" or deviation is None or deviation < LOOKED_AT:
        return 0.0
    other = cast(MirrorRule, {"never": "always", "always": "never"}[mirror])
    # A rough drawing's fit has another objective than one that trusts the drawing in full.
    own = found.objective if found.trust == 1.0 else _objective(model, observations, mirror)
    return max(0.0, own - _objective(model, observations, other))


def percentile_beside(percentile: float, nats: float) -> float:
    """Percentile of a shape among real ones: for one of the other side, at most the odds (%) that it is not."""
    return percentile if nats <= FAR_BETTER_NATS else min(percentile, 100.0 * float(np.exp(-nats)))


def other_side_warnings(nats: float) -> tuple[str, ...]:
    """What to tell of a mirror image that is far better."""
    if nats <= FAR_BETTER_NATS:
        return ()
    sentence = (
        "The mirror image of the drawing fits the model far better: it may be of the other side, or of an image whose "
        "left and right were exchanged; mirror=auto tries both."
    )
    return (sentence,)


def _objective(model: ShapeModel, observations: Observations, side: MirrorRule) -> float:
    """Negative log posterior (nats) of the best fit on a side, on all of the observations."""
    return fit(model, observations, FitOptions(mirror=side, robust=False)).objective
