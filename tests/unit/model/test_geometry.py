import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from model.geometry import COINCIDENCE_TOLERANCE_MM, POSE_SIZE, Grid, Pose
from tests.analytic_shapes import Ellipsoid


def vectors(size: int, reach: float) -> st.SearchStrategy[np.ndarray]:
    return arrays(float, size, elements=st.floats(-reach, reach, allow_subnormal=False))


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    rotation = Rotation.from_rotvec(draw(vectors(3, 3.0))).as_matrix()
    return Pose(draw(vectors(3, 300.0)), rotation, draw(st.floats(-1.0, 1.0)), draw(st.booleans()))


@st.composite
def grids(draw: st.DrawFn) -> Grid:
    rotation = Rotation.from_rotvec(draw(vectors(3, 3.0))).as_matrix()
    flip = np.diag([draw(st.sampled_from([-1.0, 1.0])), 1.0, 1.0])
    affine = np.eye(4)
    affine[:3, :3] = rotation @ flip * draw(arrays(float, 3, elements=st.floats(0.1, 8.0)))
    affine[:3, 3] = draw(vectors(3, 300.0))
    return Grid(draw(st.tuples(*[st.integers(1, 5)] * 3)), affine)


def points(count: int = 7) -> np.ndarray:
    return 20.0 * np.random.default_rng(3).normal(size=(count, 3))


class TestGrid:
    @given(grids())
    def test_index_and_world_are_inverse(self, grid):
        np.testing.assert_allclose(grid.to_index(grid.to_world(points())), points(), atol=1e-8)
        np.testing.assert_allclose(grid.to_world(grid.to_index(points())), points(), atol=1e-8)

    @given(grids())
    def test_spacing_and_directions_make_up_the_affine(self, grid):
        np.testing.assert_allclose(np.linalg.norm(grid.directions, axis=0), 1.0)
        np.testing.assert_allclose(grid.directions * grid.spacing, grid.affine[:3, :3], atol=1e-12)

    @given(grids())
    def test_a_step_along_an_index_is_one_spacing_along_its_direction(self, grid):
        origin = grid.to_world(np.zeros((1, 3)))
        np.testing.assert_allclose(
            (grid.to_world(np.eye(3)) - origin).T, grid.directions * grid.spacing, rtol=1e-9, atol=1e-9
        )
        np.testing.assert_allclose(origin[0], grid.affine[:3, 3])

    @given(grids())
    def test_centres_run_with_the_last_index_fastest(self, grid):
        centres = grid.centres()
        assert centres.shape == (np.prod(grid.shape), 3)
        index = np.array(list(np.ndindex(grid.shape)), dtype=float)
        np.testing.assert_allclose(grid.to_index(centres), index, atol=1e-8)

    @given(grids(), st.sampled_from([0.3, 3.0]), vectors(3, 1.0).filter(lambda v: np.abs(v).max() > 0.9))
    def test_grids_coincide_within_the_tolerance(self, grid, factor, direction):
        affine = grid.affine.copy()
        affine[:3, 3] += factor * COINCIDENCE_TOLERANCE_MM * direction / np.abs(direction).max()
        assert grid.coincides_with(Grid(grid.shape, affine)) == (factor < 1)

    def test_grids_that_differ_only_in_shape_or_at_a_far_corner_do_not_coincide(self):
        grid = Grid((50, 60, 70), np.eye(4))
        assert not grid.coincides_with(Grid((50, 60, 71), np.eye(4)))
        for axis in range(3):
            affine = np.eye(4)
            affine[axis, axis] += 2 * COINCIDENCE_TOLERANCE_MM / 49
            assert not grid.coincides_with(Grid(grid.shape, affine))


class TestPose:
    @given(poses())
    def test_world_and_canonical_are_inverse(self, pose):
        np.testing.assert_allclose(pose.to_world(pose.to_canonical(points())), points(), atol=1e-8)
        np.testing.assert_allclose(pose.to_canonical(pose.to_world(points())), points(), atol=1e-8)

    @given(poses())
    def test_position_is_where_the_canonical_origin_lies(self, pose):
        np.testing.assert_allclose(pose.to_world(np.zeros((1, 3)))[0], pose.position, atol=1e-9)

    @given(poses())
    def test_distances_scale_and_only_mirroring_turns_the_hand(self, pose):
        canonical = pose.to_canonical(points())
        ratio = np.linalg.norm(np.diff(canonical, axis=0), axis=1) / np.linalg.norm(np.diff(points(), axis=0), axis=1)
        np.testing.assert_allclose(ratio, np.exp(pose.log_scale))
        assert np.linalg.det(pose.linear) == pytest.approx(
            (-1.0 if pose.mirrored else 1.0) * np.exp(3 * pose.log_scale)
        )

    def test_mirroring_exchanges_left_and_right_alone(self):
        np.testing.assert_array_equal(Pose(mirrored=True).to_canonical(points()), points() * [-1.0, 1.0, 1.0])
        np.testing.assert_array_equal(Pose().to_canonical(points()), points())

    @given(poses())
    def test_no_step_leaves_the_pose(self, pose):
        found = pose.moved(np.zeros(POSE_SIZE))
        np.testing.assert_allclose(found.linear, pose.linear)
        np.testing.assert_array_equal(found.position, pose.position)

    @given(poses(), vectors(POSE_SIZE, 1.0))
    def test_a_step_shifts_turns_and_scales_in_the_canonical_frame(self, pose, step):
        moved = pose.moved(step)
        turn = np.exp(step[6]) * Rotation.from_rotvec(step[3:6]).as_matrix()
        expected = pose.to_canonical(points() - step[:3]) @ turn.T
        np.testing.assert_allclose(moved.to_canonical(points()), expected, atol=1e-8)
        assert moved.mirrored == pose.mirrored
        np.testing.assert_allclose(moved.rotation @ moved.rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(moved.rotation) == pytest.approx(1.0)

    @given(poses())
    def test_jacobian_is_that_of_finite_differences(self, pose):
        shape = Ellipsoid((9.0, 12.0, 7.0), np.array([2.0, -1.0, 3.0]))
        world = pose.to_world(points())
        canonical = pose.to_canonical(world)
        found = pose.jacobian(canonical, shape.logits_and_gradients(canonical)[1])
        step = 1e-5
        for number, axis in enumerate(np.eye(POSE_SIZE)):
            ahead = shape.logits(pose.moved(step * axis).to_canonical(world))
            behind = shape.logits(pose.moved(-step * axis).to_canonical(world))
            np.testing.assert_allclose(found[:, number], (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-6)

    @given(poses())
    def test_gradient_goes_to_the_world_by_the_chain_rule(self, pose):
        shape = Ellipsoid((9.0, 12.0, 7.0))
        world = pose.to_world(points())
        gradient = shape.logits_and_gradients(pose.to_canonical(world))[1]
        found = pose.gradient_to_world(gradient)
        step = 1e-4
        for number, axis in enumerate(np.eye(3)):
            ahead = shape.logits(pose.to_canonical(world + step * axis))
            behind = shape.logits(pose.to_canonical(world - step * axis))
            np.testing.assert_allclose(found[:, number], (ahead - behind) / (2 * step), rtol=1e-4, atol=1e-5)
