"""A drawing of a case as calibration sees it: fitted, with voxels near the true surface by which it is judged."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from model.bundle import ShapeModel
from model.inference.discrepancy.conditioning import DiscrepancyPrior, corrected, with_discrepancy
from model.inference.fitting import Fit, FitOptions, fit
from model.inference.observations import Observations, observe
from model.inference.reconstruction import COVER_SHARE_OF_BAND, OBSERVATION_BUDGET
from model.inference.thick_slices import through_thickness
from training.cohorts.cohort import Case
from training.oblique import SliceStacks

#: Voxels this close to the true surface are scored (mm, or voxels where they are larger), at most so many of a case.
BAND_MM, BAND_VOXELS = 5.0, 1.5
SCORED_VOXELS = 4000


@dataclass(frozen=True)
class ScoredDrawing:
    """A fit to one drawing of a case with its discrepancy, and voxels (world mm) near the true surface with labels."""

    drawing: SliceStacks
    observations: Observations
    found: Fit
    points: Float[np.ndarray, "n 3"]
    truth: Bool[np.ndarray, "n"]

    def corrected(self, model: ShapeModel, prior: DiscrepancyPrior) -> Fit:
        """The fit with its discrepancy under another prior."""
        return corrected(model, self.found, self.drawing.stacks, self.observations, prior)


def scored_drawing(model: ShapeModel, case: Case, drawing: SliceStacks) -> ScoredDrawing:
    """A drawing of a case, fitted at the model's likelihood precision."""
    stacks = drawing.stacks
    observations = observe(stacks, drawing.planes, budget=OBSERVATION_BUDGET, cover=COVER_SHARE_OF_BAND, seed=0)
    options = FitOptions(robust=False)
    fitted = fit(model, observations, options)
    found, _ = through_thickness(model, fitted, stacks, observations, options)
    found = with_discrepancy(model, found, stacks, observations, DiscrepancyPrior())
    index = np.argwhere(near_surface(case.mask, case.grid.spacing))
    index = index[:: max(1, -(-len(index) // SCORED_VOXELS))]
    points, truth = case.grid.to_world(index.astype(float)), case.mask[tuple(index.T)]
    return ScoredDrawing(drawing, observations, found, points, truth)


def near_surface(mask: Bool[np.ndarray, "i j k"], spacing: Float[np.ndarray, "3"]) -> Bool[np.ndarray, "i j k"]:
    """Voxels within `BAND_MM`, and `BAND_VOXELS`, of the surface of a mask; all of them where it fills its grid."""
    if mask.all():
        return mask
    inside, outside = distance_transform_edt(mask, spacing), distance_transform_edt(~mask, spacing)
    return np.asarray(np.where(mask, inside, outside) <= max(BAND_MM, BAND_VOXELS * float(spacing.max())))
