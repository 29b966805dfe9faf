"""What a completed drawing changes, as a field."""

import pickle

import numpy as np

from model.geometry import CanonicalLattice
from model.inference.completion.completing import FADING_MM, weights_of
from model.inference.completion.field import Completion

LATTICE = CanonicalLattice((24, 32, 40), 0.8)
POINTS = LATTICE.points()
WAVE = np.array([0.2, 0.1, 0.15])
#: A smooth field that vanishes on the border.
FIELD = Completion(LATTICE, weights_of(LATTICE) * (2.0 * np.sin(POINTS @ WAVE)).reshape(LATTICE.voxels))
PLACES = np.random.default_rng(0).uniform(-1.0, 1.0, (300, 3)) * (LATTICE.half_mm + 2.0)


def test_shifts_are_those_of_the_lattice_at_its_voxels_and_smooth_between_them():
    np.testing.assert_allclose(FIELD.at(POINTS), FIELD.shifts.ravel(), atol=1e-5)
    inner = PLACES[(np.abs(PLACES) < LATTICE.half_mm - FADING_MM - 1.0).all(axis=1)]
    assert len(inner) > 10
    np.testing.assert_allclose(FIELD.at(inner), 2.0 * np.sin(inner @ WAVE), atol=5e-3)


def test_beyond_the_lattice_there_is_none_and_no_step_on_its_border():
    outer = (np.abs(PLACES) >= LATTICE.half_mm).any(axis=1)
    assert outer.any()
    np.testing.assert_allclose(FIELD.at(PLACES[outer]), 0.0, atol=1e-6)
    border = np.array([[LATTICE.half_mm[0], 1.0, 2.0]])
    np.testing.assert_allclose(FIELD.at(border - np.array([1e-3, 0.0, 0.0])), 0.0, atol=1e-4)


def test_weights_are_one_well_within_and_fall_to_the_border():
    weights, depth = weights_of(LATTICE).ravel(), (LATTICE.half_mm - np.abs(POINTS)).min(axis=1)
    np.testing.assert_allclose(weights[depth >= FADING_MM], 1.0)
    np.testing.assert_allclose(weights[depth == 0.0], 0.0)
    assert ((weights >= 0.0) & (weights <= 1.0)).all()


def test_the_gradient_is_the_fields():
    inner = PLACES[(np.abs(PLACES) < LATTICE.half_mm - 0.5).all(axis=1)]
    steps = 0.01 * np.eye(3)
    changes = np.stack([(FIELD.at(inner + e) - FIELD.at(inner - e)) / 0.02 for e in steps], axis=1)
    np.testing.assert_allclose(FIELD.gradient(inner), changes, atol=0.01)


def test_what_travels_is_what_it_was_made_of():
    FIELD.at(PLACES)
    there = pickle.loads(pickle.dumps(FIELD))
    assert "_splines" not in vars(there)
    np.testing.assert_array_equal(there.at(PLACES), FIELD.at(PLACES))
