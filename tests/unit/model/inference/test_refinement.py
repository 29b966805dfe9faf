import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from model.errors import InvalidParameter
from model.inference.refinement import Refinement, mixed_cells
from tests.analytic_shapes import Box, Ellipsoid, Torus, sphere

LOW, HIGH = np.array([-14.0, -13.0, -15.3]), np.array([15.2, 13.0, 14.0])
TURN = Rotation.from_rotvec([0.3, 0.5, 0.2]).as_matrix()
FIELDS = {
    "ball": sphere(8.0, (0.3, -0.2, 0.1)).logits,
    "ellipsoid": Ellipsoid((4.0, 6.0, 11.0), rotation=TURN).logits,
    "torus": lambda points: Torus(9.0, 1.2).logits(points @ TURN),
    "plate": Box((9.0, 9.0, 0.6)).logits,
}


def run(field, factor, step=1.0):
    refinement = Refinement(LOW, HIGH, step, factor)
    asked = []
    while len(points := refinement.query()):
        asked.append(points)
        refinement.update(field(points))
    return refinement, np.concatenate(asked)


def dense(field, shape, step=1.0):
    nodes = LOW + np.argwhere(np.ones(shape, bool)) * step
    return nodes, field(nodes).reshape(shape)


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("factor", [1, 2, 4])
def test_every_node_has_the_sign_of_the_field(name, factor):
    grid = run(FIELDS[name], factor)[0].grid()
    np.testing.assert_array_equal(grid > 0, dense(FIELDS[name], grid.shape)[1] > 0)


@pytest.mark.parametrize("name", FIELDS)
def test_nodes_of_cells_with_a_sign_change_are_evaluated(name):
    grid = run(FIELDS[name], 4)[0].grid()
    truth = dense(FIELDS[name], grid.shape)[1]
    cells = mixed_cells(truth > 0, 1)
    for corner in np.ndindex(2, 2, 2):
        window = tuple(slice(first, first + size) for first, size in zip(corner, cells.shape, strict=True))
        np.testing.assert_allclose(grid[window][cells], truth[window][cells], atol=1e-5)


@pytest.mark.parametrize("factor", [1, 2, 4, 8])
def test_no_point_is_asked_twice(factor):
    refinement, points = run(FIELDS["torus"], factor)
    assert len(np.unique(np.round(points, 6), axis=0)) == len(points) == refinement.evaluations


def test_linear_field_is_reproduced_everywhere():
    def plane(points):
        return points @ np.array([0.3, -0.5, 0.8]) + 1.0

    grid = run(plane, 8)[0].grid()
    np.testing.assert_allclose(grid, dense(plane, grid.shape)[1], atol=1e-4)


def test_surface_that_leaves_the_refined_region_is_followed():
    def spike(points):
        """A ball with a needle that no coarse node comes near, in a field that is flat elsewhere."""
        needle = 0.8 - np.hypot(points[:, 1] - 1.5, points[:, 2] + 0.3)
        needle = np.where((points[:, 0] > 0) & (points[:, 0] < 11.6), needle, -1.0)
        return np.clip(np.maximum(sphere(5.0).logits(points), needle), -0.2, 0.2)

    grid = run(spike, 4)[0].grid()
    np.testing.assert_array_equal(grid > 0, dense(spike, grid.shape)[1] > 0)


def test_first_node_is_at_the_lower_corner_and_the_last_covers_the_upper():
    refinement, points = run(FIELDS["ball"], 4)
    assert refinement.grid().shape == (31, 27, 31)
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
