"""A mask by values near its surface is the mask by values everywhere."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from model.geometry import Grid
from model.inference.one_body import OCCUPIED, body_mask, body_probability
from model.inference.reconstruction import Options, reconstruct
from model.inference.uncertainty import occupancy
from model.inference.voxels import inside_mask, positive_nodes
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import ORTHOGONAL, cube_around, drawn

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
OBJECT = Ellipsoid((13.0, 8.0, 7.5), CENTRE)
ANSWER = reconstruct(MODEL, [drawn(OBJECT, cube_around(CENTRE), ORTHOGONAL)], Options(annotated=ORTHOGONAL))


class Counted:
    """Ellipsoid fields over index places, the largest of all, which count what they are asked."""

    def __init__(self, *ellipsoids: tuple[np.ndarray, np.ndarray]) -> None:
        self.ellipsoids = ellipsoids
        self.asked = 0

    def __call__(self, places: np.ndarray) -> np.ndarray:
        self.asked += len(places)
        return np.max(
            [axes.min() * (1.0 - np.linalg.norm((places - centre) / axes, axis=1)) for centre, axes in self.ellipsoids],
            axis=0,
        )

    def everywhere(self, shape: tuple[int, int, int]) -> np.ndarray:
        """Positive nodes, asked one by one."""
        return (self(np.indices(shape).reshape(3, -1).T.astype(float)) > 0).reshape(shape)


def oblique(spacing: float) -> Grid:
    """A grid through the object that is turned, sheared nowhere, and coarser along its last axis."""
    angle = 0.4
    turn = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, -1.0]])
    affine = np.eye(4)
    affine[:3, :3] = turn @ np.diag([spacing, spacing, 2.0 * spacing])
    shape = (int(44 / spacing), int(36 / spacing), int(18 / spacing))
    affine[:3, 3] = CENTRE - affine[:3, :3] @ (np.array(shape) / 2.0)
    return Grid(shape, affine)


@settings(deadline=None)
@given(
    centres=arrays(float, (2, 3), elements=st.floats(-5.0, 45.0)),
    axes=arrays(float, (2, 3), elements=st.floats(2.0, 30.0)),
    shape=st.tuples(*[st.integers(1, 40)] * 3),
)
def test_positive_nodes_are_those_of_the_field_itself(centres, axes, shape):
    field = Counted(*zip(centres, axes, strict=True))
    everywhere = field.everywhere(shape)
    assert np.array_equal(positive_nodes(field, np.array(shape)), everywhere)


@pytest.mark.parametrize("value", [-1.0, 1.0])
def test_a_field_of_one_sign_fills_all_or_nothing(value):
    mask = positive_nodes(lambda places: np.full(len(places), value), np.array([20, 30, 9]))
    assert mask.shape == (20, 30, 9)
    assert np.all(mask == (value > 0))


def test_few_nodes_are_asked():
    shape = (97, 97, 97)
    field = Counted((np.full(3, 48.0), np.array([30.0, 25.0, 35.0])))
    mask = positive_nodes(field, np.array(shape))
    assert field.asked < 0.2 * mask.size
    assert np.array_equal(mask, field.everywhere(shape))


@pytest.mark.parametrize("spacing", [0.6, 1.0, 4.0])
def test_the_mask_of_a_reconstruction_is_where_occupancy_is_more_likely_than_not(spacing):
    grid = oblique(spacing)
    assert np.array_equal(inside_mask(MODEL, ANSWER.state.fits[0], grid), occupancy(MODEL, ANSWER.state, grid) >= 0.5)
    likely = body_probability(MODEL, ANSWER.state, ANSWER.mesh, grid) >= OCCUPIED
    assert np.array_equal(body_mask(MODEL, ANSWER.state, ANSWER.mesh, grid), likely)
    assert likely.any()


def test_a_grid_elsewhere_has_an_empty_mask():
    affine = np.eye(4)
    affine[:3, 3] = CENTRE + 500.0
    assert not inside_mask(MODEL, ANSWER.state.fits[0], Grid((8, 9, 10), affine)).any()
