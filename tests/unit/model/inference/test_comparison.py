"""Signed distance of surfaces: spheres about one middle have exact answers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.inference.comparison import SIGNED_DISTANCE, compared, signed_distance
from model.inference.isosurface import extract_surface
from model.inference.mesh import transformed
from tests.analytic_shapes import Ellipsoid


def ball(radius: float):
    bound = np.full(3, radius + 3.0)
    return extract_surface(Ellipsoid((radius, radius, radius)).logits, -bound, bound, 1.0)


INNER, OUTER = ball(10.0), ball(13.0)


def test_one_sphere_lies_as_far_outside_another_as_their_radii_differ():
    assert compared(OUTER, INNER).scalars[SIGNED_DISTANCE] == pytest.approx(3.0, abs=0.1)
    assert compared(INNER, OUTER).scalars[SIGNED_DISTANCE] == pytest.approx(-3.0, abs=0.1)


def test_a_surface_is_at_no_distance_from_itself():
    assert compared(OUTER, OUTER).scalars[SIGNED_DISTANCE] == pytest.approx(0.0, abs=1e-9)


@given(st.floats(2.0, 20.0), st.integers(0, 2**32 - 1))
def test_points_are_outside_or_inside_by_their_radius(radius, seed):
    direction = np.random.default_rng(seed).normal(size=3)
    point = radius * direction / np.linalg.norm(direction)
    assert signed_distance(point[None], INNER)[0] == pytest.approx(radius - 10.0, abs=0.12)


def test_both_may_be_moved_together():
    affine = np.array([[0.0, -1.0, 0.0, 5.0], [1.0, 0.0, 0.0, -7.0], [0.0, 0.0, 1.0, 2.0], [0.0, 0.0, 0.0, 1.0]])
    shift = np.eye(4)
    shift[0, 3] = 2.0
    other = transformed(INNER, shift)
    before = compared(OUTER, other).scalars[SIGNED_DISTANCE]
    after = compared(transformed(OUTER, affine), transformed(other, affine)).scalars[SIGNED_DISTANCE]
    assert after == pytest.approx(before, abs=1e-9)


def test_other_scalars_do_not_stay():
    painted = OUTER.with_scalars(surface_sd_mm=np.ones(len(OUTER.vertices)))
    assert list(compared(painted, INNER).scalars) == [SIGNED_DISTANCE]
