"""The completed drawing as a field."""

import pickle

import numpy as np

from model.geometry import CanonicalLattice
from model.inference.completion.field import FADING_MM, Completion

LATTICE = CanonicalLattice((24, 32, 40), 0.8)
POINTS = LATTICE.points()
#: A smooth field.
FIELD = Completion(LATTICE, (2.0 * np.sin(POINTS @ [0.2, 0.1, 0.15])).reshape(LATTICE.voxels), 0.6)
PLACES = np.random.default_rng(0).uniform(-1.0, 1.0, (300, 3)) * (LATTICE.half_mm + 2.0)


def differences(of, places, step=1e-3):
    return np.stack([(of(places + e) - of(places - e)) / (2 * step) for e in step * np.eye(3)], axis=1)


def test_distances_are_those_of_the_lattice_at_its_voxels():
    np.testing.assert_allclose(FIELD.distance(POINTS), FIELD.distances.ravel(), atol=1e-5)


def test_between_voxels_the_field_is_smooth():
    inner = PLACES[(np.abs(PLACES) < LATTICE.half_mm - 4.0).all(axis=1)]
    np.testing.assert_allclose(FIELD.distance(inner), 2.0 * np.sin(inner @ [0.2, 0.1, 0.15]), atol=1e-3)


def test_it_counts_well_within_the_lattice_and_no_more_at_its_border():
    inner = (np.abs(PLACES) < LATTICE.half_mm - FADING_MM).all(axis=1)
    outer = (np.abs(PLACES) >= LATTICE.half_mm).any(axis=1)
    assert inner.any()
    assert outer.any()
    np.testing.assert_allclose(FIELD.weight(PLACES[inner]), 0.6)
    np.testing.assert_array_equal(FIELD.weight(PLACES[outer]), 0.0)
    assert ((FIELD.weight(PLACES) >= 0.0) & (FIELD.weight(PLACES) <= 0.6)).all()


def test_gradients_are_those_of_weight_and_distance():
    inner = PLACES[(np.abs(PLACES) < LATTICE.half_mm - 0.5).all(axis=1)]
    by_weight, by_distance = FIELD.gradients(inner)
    np.testing.assert_allclose(by_weight, differences(FIELD.weight, inner), atol=3e-3)
    np.testing.assert_allclose(by_distance, differences(FIELD.distance, inner, 0.02), atol=1e-2)


def test_what_travels_is_what_it_was_made_of():
    FIELD.distance(PLACES)
    there = pickle.loads(pickle.dumps(FIELD))
    assert "_splines" not in vars(there)
    np.testing.assert_array_equal(there.distance(PLACES), FIELD.distance(PLACES))
