import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.errors import InvalidParameter
from model.inference.refinement import Refinement
from tests.analytic_shapes import Box, Ellipsoid, Torus, sphere

LOW, HIGH = np.array([-14.0, -13.0, -15.3]), np.array([15.2, 13.0, 14.0])
TURN = Rotation.from_rotvec([0.3, 0.5, 0.2]).as_matrix()
CORNERS = np.argwhere(np.ones((2, 2, 2), bool))


def touching(points):
    """Two balls 0.4 mm apart."""
    return np.maximum(sphere(5.0, (5.3, 0.2, 0.1)).logits(points), sphere(5.0, (-5.1, 0.2, 0.1)).logits(points))


def saturated(points):
    return 8.0 * np.tanh(Ellipsoid((4.0, 6.0, 11.0), rotation=TURN).logits(points) / 2.0)


FIELDS = {
    "ball": sphere(8.0, (0.3, -0.2, 0.1)).logits,
    "ellipsoid": Ellipsoid((4.0, 6.0, 11.0), rotation=TURN).logits,
    "saturated": saturated,
    "torus": lambda points: Torus(9.0, 1.2).logits(points @ TURN),
    "plate": Box((9.0, 9.0, 0.6)).logits,
    "balls that almost touch": touching,
    "through the border": sphere(11.0, (7.0, 6.0, 8.0)).logits,
}


def run(field, factor, step=1.0, steepest=None):
    refinement = Refinement(LOW, HIGH, step, factor, steepest)
    asked = []
    while len(points := refinement.query()):
        asked.append(points)
        refinement.update(field(points))
    return refinement, np.concatenate(asked)


def dense_crossed(field, shape, step=1.0):
    """Cells of the whole grid, with a negative layer around it, that have a sign change."""
    nodes = np.argwhere(np.ones(shape, bool))
    inside = np.pad((field(LOW + nodes * step) > 0).reshape(shape), 1)
    windows = np.stack([inside[tuple(slice(c, n + 1 + c) for c, n in zip(k, shape, strict=True))] for k in CORNERS])
    return np.argwhere(windows.any(axis=0) & ~windows.all(axis=0)) - 1


def rows(cells):
    return {tuple(cell) for cell in cells.tolist()}


def same_as_dense(field, factor, step=1.0, steepest=None):
    refinement = run(field, factor, step, steepest)[0]
    cells, values = refinement.crossed()
    assert len(rows(cells)) == len(cells)
    assert rows(cells) == rows(dense_crossed(field, tuple(refinement.shape), step))
    nodes = cells[:, None] + CORNERS
    within = ((nodes >= 0) & (nodes < refinement.shape)).all(axis=2)
    np.testing.assert_allclose(values[within], field(LOW + nodes[within] * step), atol=1e-4)


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("factor", [1, 2, 4, 8])
def test_the_cells_of_the_surface_are_those_of_the_whole_grid(name, factor):
    same_as_dense(FIELDS[name], factor)


turns = st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(rng=np.random.default_rng(seed)).as_matrix())
shifts = st.tuples(*[st.floats(-4.0, 4.0)] * 3).map(np.array)
halves = st.floats(0.02, 1.0)


@pytest.mark.parametrize("steepest", [None, 1.0])
@pytest.mark.parametrize("factor", [2, 4, 8])
@given(turn=turns, shift=shifts, half=halves)
def test_no_part_of_a_thin_plate_is_missed(steepest, factor, turn, shift, half):
    same_as_dense(lambda points: Box((8.0, 7.0, half)).logits((points - shift) @ turn), factor, 1.0, steepest)


@pytest.mark.parametrize("steepest", [None, 1.0])
@pytest.mark.parametrize("factor", [2, 4, 8])
@given(turn=turns, shift=shifts, half=halves)
def test_no_part_of_a_needle_is_missed(steepest, factor, turn, shift, half):
    same_as_dense(lambda points: Box((9.0, half, half)).logits((points - shift) @ turn), factor, 1.0, steepest)


@pytest.mark.parametrize("steepest", [None, 1.0])
@pytest.mark.parametrize("factor", [2, 4, 8])
@given(shift=shifts, radius=st.floats(0.1, 2.0), gap=st.floats(0.02, 2.0))
def test_neither_of_two_near_balls_is_missed(steepest, factor, shift, radius, gap):
    big, small = sphere(6.0), sphere(radius, (6.0 + radius + gap, 0.0, 0.0))
    same_as_dense(
        lambda points: np.maximum(big.logits(points - shift), small.logits(points - shift)), factor, 1.0, steepest
    )


def test_a_field_that_is_flat_beside_a_part_needs_its_slope():
    def clipped(points):
        return np.clip(Box((6.0, 5.0, 0.7)).logits((points - 0.5) @ TURN), -0.2, 0.2)

    same_as_dense(clipped, 8, steepest=1.0)


@pytest.mark.parametrize("factor", [1, 2, 4, 8])
def test_no_point_is_asked_twice(factor):
    refinement, points = run(FIELDS["torus"], factor)
    assert len(np.unique(np.round(points, 6), axis=0)) == len(points) == refinement.evaluations


def test_surface_that_leaves_the_refined_region_is_followed():
    def spike(points):
        """A ball with a needle that no coarse node comes near, in a field that is flat elsewhere."""
        needle = 0.8 - np.hypot(points[:, 1] - 1.5, points[:, 2] + 0.3)
        needle = np.where((points[:, 0] > 0) & (points[:, 0] < 11.6), needle, -1.0)
        return np.clip(np.maximum(sphere(5.0).logits(points), needle), -0.2, 0.2)

    same_as_dense(spike, 4)


def test_first_node_is_at_the_lower_corner_and_the_last_covers_the_upper():
    refinement, points = run(FIELDS["ball"], 4)
    np.testing.assert_array_equal(refinement.shape, (31, 27, 31))
    np.testing.assert_array_equal(points.min(axis=0), LOW)


@pytest.mark.parametrize(
    ("low", "high", "step", "factor", "part"),
    [
        (LOW, HIGH, -1.0, 4, "resolution_mm"),
        (LOW, HIGH, float("inf"), 4, "resolution_mm"),
        (LOW, LOW, 1.0, 4, "box"),
        (LOW, np.full(3, np.inf), 1.0, 4, "box"),
        (LOW, HIGH, 1.0, 0, "coarse_factor"),
        (LOW, HIGH, 1.0, 6, "coarse_factor"),
    ],
)
def test_impossible_grids_are_refused(low, high, step, factor, part):
    with pytest.raises(InvalidParameter) as refusal:
        Refinement(low, high, step, factor)
    assert refusal.value.part == part
