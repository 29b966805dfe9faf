"""Spread and sharpness, recovered from voxels whose labels were drawn with known ones."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from model.geometry import Grid
from model.inference.discrepancy.conditioning import DiscrepancyPrior
from model.inference.posterior import (
    fitted_jacobians,
    laplace_covariance,
    logit_variance,
    mean_probability,
    open_variance,
)
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import cube_around
from training.cohorts.cohort import Case
from training.oblique import in_one_stack
from training.probability_scale import ProbabilityScale, as_facts, best_scale, cross_entropies
from training.scored_drawing import BAND_MM, SCORED_VOXELS, near_surface, scored_drawing
from training.sparsify import for_evaluation

FIDELITY = 0.7
PLAIN = ellipsoid_model()
MODEL = replace(
    PLAIN,
    manifest=replace(
        PLAIN.manifest, likelihood_precision=0.1, discrepancy={"spread_mm": 0.6, "fidelity": FIDELITY}, posterior={}
    ),
)
CENTRE = np.array([30.0, -20.0, 50.0])
GRID = cube_around(CENTRE, nodes=37)
CASE = Case("one", "one", "validation", Ellipsoid((13.0, 9.0, 6.5), CENTRE).mask(GRID), GRID)


@cache
def drawing(regime="orthogonal"):
    return scored_drawing(MODEL, CASE, in_one_stack(for_evaluation(CASE.mask, CASE.grid, regime)))


def labelled(spread_mm, sharpness, copies=6):
    """Drawings of which the labels come from the posterior of a field so sharp under a discrepancy so wide."""
    seen = drawing()
    found = seen.corrected(MODEL, DiscrepancyPrior(1.0, FIDELITY))
    logits, by_parameter, _ = fitted_jacobians(MODEL, found, seen.points)
    variance = logit_variance(by_parameter, laplace_covariance(found))
    variance = variance + spread_mm**2 * open_variance(found, seen.points)
    said = mean_probability(logits, variance, sharpness)
    random = np.random.default_rng(3)
    return [replace(seen, truth=random.random(len(said)) < said) for _ in range(copies)]


@pytest.mark.parametrize("known", [(0.2, 1.0), (1.0, 1.0), (1.0, 4.0), (0.35, 0.7)])
def test_what_labels_were_drawn_with_is_found(known):
    found = cross_entropies(MODEL, labelled(*known))
    lowest, at_known = min(found.values()), found[ProbabilityScale(*known)]
    assert at_known <= lowest * 1.005
    best = best_scale(found)
    # Both soften probabilities; the softer of two fields has the narrower discrepancy.
    assert np.sign(best.sharpness - known[1]) * np.sign(best.spread_mm - known[0]) >= 0.0


def test_facts_are_told_at_the_best_of_the_other():
    found = cross_entropies(MODEL, labelled(0.35, 2.0, copies=1))
    facts, best = as_facts(found), best_scale(found)
    for name, value in (("spread", best.spread_mm), ("sharpness", best.sharpness)):
        told = facts[f"cross_entropy_by_{name}"]
        assert min(told, key=told.__getitem__) == f"{value:g}"
        assert told[f"{value:g}"] == found[best]


def test_voxels_of_both_labels_near_the_surface_are_scored():
    seen = drawing()
    assert len(seen.points) <= SCORED_VOXELS
    assert 0.2 < seen.truth.mean() < 0.8
    far = np.abs(np.linalg.norm((seen.points - CENTRE) / (13.0, 9.0, 6.5), axis=1) - 1.0) * 13.0
    assert far.max() < 13.0 / 6.5 * (BAND_MM + 1.0)


def test_the_band_lies_on_both_sides():
    mask = np.zeros((30, 8, 8), bool)
    mask[:15] = True
    rows = near_surface(mask, np.array([1.0, 1.0, 1.0])).any(axis=(1, 2))
    assert np.flatnonzero(rows).tolist() == list(range(10, 20))


@pytest.mark.parametrize("spacing", [(6.0, 6.0, 6.0), (2.0, 2.0, 12.0)])
def test_of_large_voxels_both_sides_are_scored(spacing):
    grid = Grid((15, 13, 11), np.diag([*spacing, 1.0]))
    mask = np.zeros(grid.shape, bool)
    mask[4:11, 4:9, 4:7] = True
    near = near_surface(mask, grid.spacing)
    assert (near & mask).any()
    assert (near & ~mask).any()


def test_all_of_a_mask_that_fills_its_grid_is_near():
    assert near_surface(np.ones((4, 5, 6), bool), np.ones(3)).all()
