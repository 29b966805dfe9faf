"""The fit against ellipsoids whose size and place are known, and its objective against its own derivatives."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.errors import InvalidMask
from model.geometry import POSE_SIZE, Pose
from model.inference.fitting import (
    Fit,
    FitOptions,
    FitStatus,
    fit,
    fit_from,
    pose_offset,
)
from model.inference.objective import Objective
from model.inference.observations import Observations, Plane
from model.inference.posterior import fitted_logits
from model.inference.starts import Start, starting_poses
from tests.analytic_model import (
    MEAN_AXES,
    SPREAD,
    EllipsoidDecoder,
    StandardNormalPrior,
    bent_model,
    ellipsoid_model,
)
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import (
    ORTHOGONAL,
    PARALLEL,
    DecodedShape,
    cube_around,
    drawn,
    finer,
    matrix_of,
    observed,
    rotation,
    shape_matrix,
)

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
BENT = bent_model()
#: As large as a vertebra, so that 20 mm stay within the reach of its contours.
LARGE_AXES = (45.0, 32.0, 22.0)
DRAWINGS = {"orthogonal": ORTHOGONAL, "parallel": PARALLEL}
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0), "oblique": (1.0, 1.0, 1.0)}
semi_axes = st.tuples(*(st.floats(mean * np.exp(-2 * SPREAD), mean * np.exp(2 * SPREAD)) for mean in MEAN_AXES))


@dataclass(frozen=True)
class CurvedPrior(StandardNormalPrior):
    """``z0 = z + tanh(z M) / 4`` with a matrix that couples the dimensions."""

    def to_base(self, latent):
        return latent + 0.25 * np.tanh(latent @ self._mixing)

    def base_jacobian(self, latent):
        slope = 1.0 - np.tanh(latent @ self._mixing) ** 2
        return self.to_base(latent), np.eye(3) + 0.25 * slope[:, :, None] * self._mixing.T

    @property
    def _mixing(self):
        return np.array([[1.0, 0.5, -0.2], [0.0, 0.8, 0.3], [0.4, -0.6, 1.0]])


@dataclass(frozen=True)
class MisleadingDecoder(EllipsoidDecoder):
    """Derivatives that point the wrong way."""

    def logits_and_jacobians(self, latent, points):
        logits, by_latent, by_point = super().logits_and_jacobians(latent, points)
        return logits, -by_latent, -by_point


def observations_of(ellipsoid, planes=ORTHOGONAL, *, step=1.0, nodes=41):
    return observed(drawn(ellipsoid, cube_around(ellipsoid.centre, step=step, nodes=nodes), planes), planes)


def world_matrix(model, found: Fit):
    """The fitted ellipsoid in the world."""
    axes = model.decoder.axes(found.latent[None])[0] * np.exp(-found.pose.log_scale)
    return shape_matrix(axes, found.pose.rotation.T)


@pytest.mark.parametrize("name", DRAWINGS)
@settings(max_examples=15)
@given(axes=semi_axes, place=st.tuples(*[st.floats(-200.0, 200.0)] * 3))
def test_axes_and_position_are_recovered(name, axes, place):
    ellipsoid = Ellipsoid(axes, np.array(place))
    found = fit(MODEL, observations_of(ellipsoid, DRAWINGS[name]), FitOptions())
    assert found.status is FitStatus.CONVERGED
    assert np.linalg.norm(found.pose.position - ellipsoid.centre) < 0.4
    np.testing.assert_allclose(world_matrix(MODEL, found), matrix_of(ellipsoid), atol=0.6)


def test_error_falls_with_the_voxels():
    ellipsoid = Ellipsoid((14.0, 8.0, 6.0), CENTRE + 0.3)
    errors = []
    for step, nodes in ((2.0, 21), (0.5, 81)):
        middle = nodes // 2
        planes = tuple(Plane(0, axis, middle) for axis in range(3))
        grid = cube_around(CENTRE, step=step, nodes=nodes)
        found = fit(MODEL, observed(drawn(ellipsoid, grid, planes), planes), FitOptions())
        errors.append(np.abs(world_matrix(MODEL, found) - matrix_of(ellipsoid)).max())
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < 0.15


@pytest.mark.parametrize("degrees", [10.0, 20.0])
@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("name", DRAWINGS)
def test_rotation_is_recovered(name, axis, degrees):
    ellipsoid = Ellipsoid((14.0, 9.0, 5.5), CENTRE, rotation(degrees, AXES[axis]))
    planes = finer(DRAWINGS[name])
    grid = cube_around(CENTRE, step=0.5, nodes=81)
    found = fit(MODEL, observed(drawn(ellipsoid, grid, planes), planes), FitOptions())
    assert found.status is FitStatus.CONVERGED
    turned = np.degrees(np.linalg.norm(pose_offset(Pose(rotation=ellipsoid.rotation.T), found.pose)[3:6]))
    assert turned < 3.0  # soft logits on hard labels: planes that graze the end are biased, whatever the voxel size
    np.testing.assert_allclose(world_matrix(MODEL, found), matrix_of(ellipsoid), atol=0.5)


@pytest.mark.parametrize("axis", AXES)
def test_rotation_of_a_bent_shape_is_recovered(axis):
    pose = Pose(CENTRE, rotation(-20.0, AXES[axis]))
    shape = DecodedShape(BENT, np.array([0.5, 0.5, -1.0]), pose)
    planes, grid = finer(ORTHOGONAL), cube_around(CENTRE, step=0.5, nodes=81)
    found = fit(BENT, observed(drawn(shape, grid, planes), planes), FitOptions())
    assert found.status is FitStatus.CONVERGED
    offset = pose_offset(pose, found.pose)
    assert np.linalg.norm(offset[:3]) < 0.5
    assert np.degrees(np.linalg.norm(offset[3:6])) < 2.5
    np.testing.assert_allclose(found.latent, shape.latent, atol=0.35)


@pytest.mark.parametrize("start", [(20.0, 0.0, 0.0), (0.0, -20.0, 0.0), (0.0, 0.0, 20.0), (12.0, 12.0, -11.0)])
@pytest.mark.parametrize("degrees", [0.0, 20.0])
def test_converges_from_twenty_millimetres_away(start, degrees):
    large = ellipsoid_model(mean_axes=LARGE_AXES)
    ellipsoid = Ellipsoid((50.0, 30.0, 20.0), CENTRE, rotation(degrees, (1.0, 1.0, 1.0)))
    observations = observed(drawn(ellipsoid, cube_around(CENTRE, step=2.7)), ORTHOGONAL)
    pose = Pose(CENTRE + start)
    found = fit_from(large, observations, [Start(pose, pose)], FitOptions())
    assert found.status is FitStatus.CONVERGED
    assert np.linalg.norm(found.pose.position - CENTRE) < 0.5
    np.testing.assert_allclose(world_matrix(large, found), matrix_of(ellipsoid), atol=1.2)


def test_planes_at_one_end_are_fitted():
    large = ellipsoid_model(mean_axes=LARGE_AXES)
    ellipsoid = Ellipsoid((45.0, 32.0, 22.0), CENTRE)
    planes = tuple(Plane(0, 0, index) for index in (4, 7, 10, 13))
    observations = observed(drawn(ellipsoid, cube_around(CENTRE, step=2.7), planes), planes)
    start = starting_poses(observations, FitOptions())[0]
    assert np.linalg.norm(start.position - CENTRE) > 20.0
    found = fit(large, observations, FitOptions())
    assert found.status is FitStatus.CONVERGED
    assert np.linalg.norm(found.pose.position - CENTRE) < 0.6 * np.linalg.norm(start.position - CENTRE)
    inside = fitted_logits(large, found, observations.points) > 0
    assert observations.weights @ (inside != observations.labels) < 0.05 * (observations.weights @ observations.labels)


def random_case(seed, *, mirrored=False):
    """Objective, code and pose away from any optimum; the pose's prior pulls as well."""
    rng = np.random.default_rng(seed)
    model = replace(BENT, prior=CurvedPrior())
    count = 200
    observations = Observations(
        CENTRE + rng.normal(scale=8.0, size=(count, 3)),
        rng.integers(0, 2, count).astype(float),
        rng.uniform(0.1, 2.0, count),
        ORTHOGONAL,
        np.zeros(count, int),
    )
    start = Pose(CENTRE + rng.normal(size=3), rotation(15.0, (1.0, 2.0, -1.0)), 0.02, mirrored)
    objective = Objective(model, observations, start, FitOptions())
    pose = start.moved(rng.normal(size=POSE_SIZE) * np.array([2.0] * 3 + [0.3] * 3 + [0.05]))
    return objective, rng.normal(size=3), pose


def moved_value(objective, latent, pose, step, sharpness):
    return objective.at(latent + step[:3], pose.moved(step[3:]), sharpness).value


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("sharpness", [0.3, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_gradient_is_that_of_the_objective(seed, sharpness, mirrored):
    objective, latent, pose = random_case(seed, mirrored=mirrored)
    gradient = objective.at(latent, pose, sharpness).gradient
    steps = 1e-5 * np.eye(3 + POSE_SIZE)
    differences = [
        moved_value(objective, latent, pose, s, sharpness) - moved_value(objective, latent, pose, -s, sharpness)
        for s in steps
    ]
    np.testing.assert_allclose(gradient, np.array(differences) / 2e-5, rtol=1e-5, atol=1e-4 * np.abs(gradient).max())


def test_curvature_is_the_hessian_where_the_labels_are_as_expected():
    model, rng = MODEL, np.random.default_rng(8)
    pose, latent = Pose(CENTRE, rotation(10.0)), np.array([0.4, -0.3, 0.2])
    points = CENTRE + rng.normal(scale=8.0, size=(300, 3))
    logits = model.decoder.logits(latent[None], pose.to_canonical(points)[None])[0]
    labels = 1.0 / (1.0 + np.exp(-logits))
    observations = Observations(points, labels, rng.uniform(0.1, 2.0, 300), ORTHOGONAL, np.zeros(300, int))
    objective = Objective(model, observations, pose, FitOptions())
    steps = 1e-5 * np.eye(3 + POSE_SIZE)
    slopes = [
        objective.at(latent + s[:3], pose.moved(s[3:])).gradient
        - objective.at(latent - s[:3], pose.moved(-s[3:])).gradient
        for s in steps
    ]
    curvature = objective.at(latent, pose).curvature
    np.testing.assert_allclose(curvature, np.array(slopes) / 2e-5, rtol=1e-4, atol=1e-5 * np.abs(curvature).max())


def test_precision_and_gradient_at_the_optimum():
    observations = observations_of(Ellipsoid((14.0, 8.0, 6.0), CENTRE))
    found = fit(MODEL, observations, FitOptions(tolerance=1e-8))
    start = starting_poses(observations, FitOptions())[0]
    point = Objective(MODEL, observations, start, FitOptions()).at(found.latent, found.pose)
    np.testing.assert_allclose(point.value, found.objective, rtol=1e-9)
    assert np.abs(np.linalg.solve(found.precision, point.gradient)).max() < 1e-3
    np.testing.assert_allclose(found.precision, found.precision.T, atol=1e-9 * np.abs(found.precision).max())
    assert np.linalg.eigvalsh(found.precision).min() > 0


@given(
    step=st.tuples(*[st.floats(-30.0, 30.0)] * 3, *[st.floats(-1.0, 1.0)] * 3, st.floats(-0.3, 0.3)).map(np.array),
    mirrored=st.booleans(),
)
def test_offset_is_the_step_between_poses(step, mirrored):
    start = Pose(CENTRE, rotation(40.0, (1.0, -2.0, 0.5)), -0.1, mirrored)
    np.testing.assert_allclose(pose_offset(start, start.moved(step)), step, atol=1e-9)


def test_starts_at_the_centroid_of_the_drawing():
    observations = observations_of(Ellipsoid((12.0, 9.0, 7.0), CENTRE))
    for rule, sides in (("never", [False]), ("always", [True]), ("auto", [False, True])):
        starts = starting_poses(observations, FitOptions(mirror=rule))
        assert [start.mirrored for start in starts] == sides
        for start in starts:
            np.testing.assert_allclose(start.position, CENTRE, atol=0.05)


def test_observations_without_foreground_are_refused():
    observations = observations_of(Ellipsoid((12.0, 9.0, 7.0), CENTRE))
    with pytest.raises(InvalidMask, match="no foreground"):
        fit(MODEL, replace(observations, labels=np.zeros_like(observations.labels)), FitOptions())


@pytest.mark.parametrize("mirrored", [False, True])
def test_auto_finds_the_side_of_a_chiral_shape(mirrored):
    shape = DecodedShape(BENT, np.array([0.4, -0.2, 0.3]), Pose(CENTRE, rotation(8.0), mirrored=mirrored))
    observations = observed(drawn(shape, cube_around(CENTRE)))
    found = fit(BENT, observations, FitOptions(mirror="auto"))
    wrong = fit(BENT, observations, FitOptions(mirror="never" if mirrored else "always"))
    assert found.pose.mirrored is mirrored
    assert found.objective < wrong.objective - 20.0


def test_sides_of_a_symmetric_shape_are_equal():
    observations = observations_of(Ellipsoid((14.0, 8.0, 6.0), CENTRE))
    never, always = (fit(MODEL, observations, FitOptions(mirror=rule)) for rule in ("never", "always"))
    assert always.objective == pytest.approx(never.objective, abs=1e-2)
    assert fit(MODEL, observations, FitOptions(mirror="auto")).objective == min(never.objective, always.objective)


def test_same_observations_give_the_same_bits():
    observations = observations_of(Ellipsoid((14.0, 8.0, 6.0), CENTRE))
    first, second = (fit(MODEL, observations, FitOptions()) for _ in range(2))
    np.testing.assert_array_equal(first.latent, second.latent)
    np.testing.assert_array_equal(first.precision, second.precision)
    np.testing.assert_array_equal(first.pose.rotation, second.pose.rotation)
    assert first.objective == second.objective


def test_objective_never_rises():
    observations = observations_of(Ellipsoid((16.0, 7.0, 6.0), CENTRE, rotation(20.0)))
    values = [fit(MODEL, observations, FitOptions(max_iterations=count)).objective for count in range(8)]
    assert all(later <= earlier for earlier, later in pairwise(values))
    assert values[-1] < values[0]


def test_limit_of_iterations_is_reported():
    observations = observations_of(Ellipsoid((16.0, 7.0, 6.0), CENTRE, rotation(20.0)))
    found = fit(MODEL, observations, FitOptions(max_iterations=1))
    assert found.status is FitStatus.ITERATION_LIMIT
    assert found.message == "The fit reached its limit of iterations before it converged."


def test_the_last_step_is_taken_without_a_look():
    observations = observations_of(Ellipsoid((14.0, 8.0, 6.0), CENTRE))
    exact, early = (fit(MODEL, observations, FitOptions(tolerance=each)) for each in (1e-8, 0.5))
    start = starting_poses(observations, FitOptions())[0]
    reached = Objective(MODEL, observations, start, FitOptions()).at(early.latent, early.pose).value
    assert early.iterations < exact.iterations
    assert reached - exact.objective < 0.05
    np.testing.assert_allclose(early.objective, reached, atol=0.1)


def test_convergence_is_reported_with_its_iterations():
    observations = observations_of(Ellipsoid((14.0, 8.0, 6.0), CENTRE))
    found = fit(MODEL, observations, FitOptions())
    assert found.message == "The fit converged: the last step was below the tolerance."
    assert 1 <= found.iterations <= 48


@pytest.mark.parametrize("tolerance", [1e-2, 1e-6, 0.0])
def test_derivatives_that_mislead_are_no_convergence(tolerance):
    model = replace(MODEL, decoder=MisleadingDecoder())
    observations = observations_of(Ellipsoid((14.0, 8.0, 6.0), CENTRE))
    found = fit(model, observations, FitOptions(tolerance=tolerance))
    assert found.status is FitStatus.STALLED
    assert found.message == "The fit stopped because no damped step lowered the objective further."


def test_points_far_outside_do_not_overflow():
    observations = observations_of(Ellipsoid((12.0, 9.0, 7.0), CENTRE))
    far = CENTRE + np.array([[1e4, 0.0, 0.0], [0.0, -1e4, 0.0]])
    wider = replace(
        observations,
        points=np.concatenate([observations.points, far]),
        labels=np.append(observations.labels, [0.0, 0.0]),
        weights=np.append(observations.weights, [1.0, 1.0]),
        plane_of=np.append(observations.plane_of, [0, 0]),
    )
    near, found = (fit(MODEL, each, FitOptions()) for each in (observations, wider))
    np.testing.assert_allclose(found.latent, near.latent, atol=1e-6)
