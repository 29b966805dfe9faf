"""Extents of ellipsoids, whose answers are exact."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from model.errors import InvalidParameter
from model.geometry import Pose
from model.inference.calipers import MOST_EXTENTS, USUAL_EXTENTS, direction_of, measure_extents, parse_extents
from model.inference.mesh import transformed
from model.inference.spread import SurfaceSpread
from model.inference.surface import surface_of
from tests.analytic_model import MEAN_AXES, ellipsoid_model
from tests.drawn_shapes import rotation

MODEL = ellipsoid_model()
MESH = surface_of(MODEL, np.zeros(3), Pose(), 0.7)


def values(mesh, *along):
    return [extent.extent_mm.value for extent in measure_extents(mesh, None, along)]


def test_extents_along_the_axes_are_the_diameters():
    assert values(MESH, "R", "A", "S") == pytest.approx(2.0 * np.array(MEAN_AXES), abs=0.05)
    assert values(MESH, "longest") == pytest.approx([2.0 * max(MEAN_AXES)], abs=0.05)


@given(st.tuples(*[st.floats(-5.0, 5.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_width_of_an_ellipsoid_in_any_direction(vector):
    direction = np.array(vector) / np.linalg.norm(vector)
    expected = 2.0 * np.linalg.norm(np.array(MEAN_AXES) * direction)
    (found,) = measure_extents(MESH, None, [" ".join(map(str, vector))])
    assert found.extent_mm.value == pytest.approx(expected, abs=0.1)
    np.testing.assert_allclose(found.direction, direction, atol=1e-9)


def test_the_longest_diameter_is_the_largest_of_all_distances():
    for vertices in (MESH.vertices, np.random.default_rng(0).standard_normal((300, 3)) * (1.0, 1.02, 1.01)):
        found = measure_extents(replace(MESH, vertices=vertices, normals=vertices), None, ["longest"])[0]
        assert found.extent_mm.value == pytest.approx(cdist(vertices, vertices).max(), abs=1e-9)


def test_the_longest_diameter_turns_with_the_surface():
    sheared = MESH.vertices + 0.05 * MESH.vertices[:, [1]] * np.array([1.0, 0.0, 1.0])  # no two diameters alike
    mesh = replace(MESH, vertices=sheared)
    turn = rotation(40.0, (1.0, 2.0, 3.0))
    affine = np.eye(4)
    affine[:3, :3] = turn
    before, after = (measure_extents(one, None, ["longest"])[0] for one in (mesh, transformed(mesh, affine)))
    assert after.extent_mm.value == pytest.approx(before.extent_mm.value, abs=1e-9)
    assert abs(np.dot(after.direction, turn @ before.direction)) == pytest.approx(1.0, abs=1e-3)


def test_an_interval_is_that_of_a_surface_that_swells():
    # Every vertex moves out together with an SD of 0.5 mm, so a width changes by twice that.
    spread = SurfaceSpread(np.full((len(MESH.vertices), 1), 0.5))
    for extent in measure_extents(MESH, spread, USUAL_EXTENTS):
        assert extent.extent_mm.high - extent.extent_mm.value == pytest.approx(1.645 * 1.0, rel=0.02)


def test_a_shift_changes_no_extent():
    factors = MESH.normals @ np.array([[0.3], [-0.8], [0.5]])
    for extent in measure_extents(MESH, SurfaceSpread(factors), USUAL_EXTENTS):
        assert extent.extent_mm.high - extent.extent_mm.low < 0.25


def test_a_flat_surface_has_extents():
    flat = replace(MESH, vertices=MESH.vertices * [1.0, 1.0, 0.0])
    assert values(flat, "S", "longest") == pytest.approx([0.0, 2.0 * max(MEAN_AXES)], abs=0.05)


def test_words_are_read_once_each_and_in_order():
    assert parse_extents(" S,R , longest,R, 0.5  0 -1e1") == ("S", "R", "longest", "0.5 0 -1e1")
    assert parse_extents("") == ()


@pytest.mark.parametrize("text", ["X", "1 2", "0 0 0", "1 2 3 4", "nan 0 1", "inf 0 1", "1,2,3", "1e400 0 0", "r"])
def test_what_is_no_direction_is_refused_by_name(text):
    with pytest.raises(InvalidParameter, match="extents must hold R, A, S, longest"):
        parse_extents(text)


@pytest.mark.parametrize("number", ["1" * 3000, "1" * 3000 + ".", "." + "1" * 3000, "1e" + "1" * 3000])
def test_a_long_text_that_is_nearly_a_direction_is_refused_as_fast_as_it_is_read(number):
    """Where digits can be read in several ways, this would take hours."""
    with pytest.raises(InvalidParameter, match="extents must hold"):
        parse_extents(f"{number} {number} {number}x")


def test_too_many_are_refused():
    with pytest.raises(InvalidParameter, match=str(MOST_EXTENTS)):
        parse_extents(",".join(f"1 0 {number}" for number in range(MOST_EXTENTS + 1)))


@given(st.tuples(*[st.floats(-1e6, 1e6, allow_subnormal=False)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_directions_are_units(vector):
    direction = direction_of(" ".join(map(repr, vector)))
    assert np.linalg.norm(direction) == pytest.approx(1.0)


def test_numbers_are_of_the_named_world_and_letters_of_the_body():
    np.testing.assert_allclose(direction_of("3 -4 0", "LPS"), [-0.6, 0.8, 0.0])
    for letter in "RAS":
        np.testing.assert_array_equal(direction_of(letter, "LPS"), direction_of(letter))
    (here,), (there,) = (measure_extents(MESH, None, ["1 2 3"], "RAS"), measure_extents(MESH, None, ["-1 -2 3"], "LPS"))
    assert there.extent_mm == here.extent_mm
    assert there.direction == here.direction
