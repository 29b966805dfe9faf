"""Distances from the fitted surface, with and without a completed drawing."""

import numpy as np
import pytest

from model.geometry import CanonicalLattice
from model.inference.completion.field import Completion
from model.inference.discrepancy.levels import REACH_MM, Levels

LATTICE = CanonicalLattice((32, 32, 32), 1.0)
COMPLETION = Completion(LATTICE, (0.4 * np.sin(LATTICE.points() @ [0.2, 0.3, 0.1])).reshape(LATTICE.voxels))
ALONE, BLENDED = Levels(2.0), Levels(2.0, COMPLETION)
PLACES = np.random.default_rng(0).uniform(-15.0, 15.0, (400, 3))
NORMAL = np.array([0.3, -0.5, 0.8])


def plane(points):
    """Logits of a half space, of the slope 2 / mm."""
    return 2.0 * (points @ NORMAL / np.linalg.norm(NORMAL) - 1.0)


GRADIENT = np.tile(2.0 * NORMAL / np.linalg.norm(NORMAL), (len(PLACES), 1))


def test_a_logit_is_a_distance_near_the_surface_and_saturates_far_from_it():
    logits = np.array([-0.02, 0.0, 0.02, 100.0])
    np.testing.assert_allclose(ALONE.at(logits, np.zeros((4, 3))), [-0.01, 0.0, 0.01, REACH_MM], atol=1e-6)


def test_a_completed_drawing_shifts_the_distance():
    expected = ALONE.at(plane(PLACES), PLACES) + COMPLETION.at(PLACES)
    np.testing.assert_allclose(BLENDED.at(plane(PLACES), PLACES), expected, atol=1e-9)
    np.testing.assert_array_equal(BLENDED.of_code(plane(PLACES)), ALONE.at(plane(PLACES), PLACES))


@pytest.mark.parametrize("levels", [ALONE, BLENDED], ids=["alone", "blended"])
def test_derivatives(levels):
    logits = plane(PLACES)
    by_logit = (levels.at(logits + 1e-4, PLACES) - levels.at(logits - 1e-4, PLACES)) / 2e-4
    np.testing.assert_allclose(levels.by_logit(logits), by_logit, atol=1e-5)
    steps = 0.01 * np.eye(3)
    changes = [levels.at(plane(PLACES + e), PLACES + e) - levels.at(plane(PLACES - e), PLACES - e) for e in steps]
    np.testing.assert_allclose(levels.gradient(logits, GRADIENT, PLACES), np.stack(changes, axis=1) / 0.02, atol=0.02)
