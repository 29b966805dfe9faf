"""Training pairs: the drawing is the label map on its planes and unknown elsewhere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.geometry import Grid
from model.inference.training_pairs import FEWEST_PLANES, LEAST_SECTION, MOST_PLANES, NOT_ANNOTATED, training_pair
from tests.analytic_shapes import Ellipsoid

GRID = Grid((24, 20, 16), np.eye(4))
DENSE = Ellipsoid((9.0, 7.0, 5.0), np.array([12.0, 10.0, 8.0])).mask(GRID).astype(np.uint8)


@given(st.integers(0, 2**53 - 1))
def test_the_drawing_is_the_label_map_on_its_planes(seed):
    pair = training_pair(DENSE, seed)
    assert FEWEST_PLANES <= len(pair.planes) <= MOST_PLANES
    assert len(set(pair.planes)) == len(pair.planes)
    drawn = np.zeros(DENSE.shape, bool)
    for axis, index in pair.planes:
        place = [slice(None)] * 3
        place[axis] = index
        drawn[tuple(place)] = True
        section = DENSE.take(index, axis).sum()
        largest = max(DENSE.take(other, axis).sum() for other in range(DENSE.shape[axis]))
        assert section >= LEAST_SECTION * largest
    np.testing.assert_array_equal(pair.sparse[drawn], DENSE[drawn])
    assert (pair.sparse[~drawn] == NOT_ANNOTATED).all()
    np.testing.assert_array_equal(pair.dense, DENSE)


def test_a_seed_always_draws_the_same_planes_and_others_differ():
    pairs = [training_pair(DENSE, seed).planes for seed in (3, 3, 4, 5)]
    assert pairs[0] == pairs[1]
    assert len(set(pairs)) == 3


def test_axes_and_numbers_of_planes_all_occur():
    pairs = [training_pair(DENSE, seed).planes for seed in range(60)]
    assert {len(planes) for planes in pairs} == set(range(FEWEST_PLANES, MOST_PLANES + 1))
    assert {axis for planes in pairs for axis, _ in planes} == {0, 1, 2}


@pytest.mark.parametrize("shape", [(3, 3, 3), (1, 1, 1)])
def test_an_object_of_few_planes_is_drawn_on_those(shape):
    dense = np.zeros((5, 5, 5), np.uint8)
    dense[tuple(slice(1, 1 + size) for size in shape)] = 1
    planes = training_pair(dense, 0).planes
    assert 1 <= len(planes) <= sum(shape)
