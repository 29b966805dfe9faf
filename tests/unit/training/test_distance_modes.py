import numpy as np
import pytest

from model.geometry import Grid, Pose
from tests.analytic_shapes import Ellipsoid
from training.baselines.distance_choice import kept, score, spread
from training.baselines.distance_fit import FitSettings, ModeFit, filled, fit_modes
from training.baselines.distance_learning import learn_modes
from training.baselines.distance_modes import DistanceModes, sampled
from training.baselines.kept_modes import digest_of, read_chosen
from training.cohorts import Case, Cohort, Provenance
from training.distance import signed_distance
from training.metrics_masks import dice
from training.oblique import in_one_stack, random_planes
from training.sparsify import for_evaluation

GRID = Grid((40, 38, 42), np.array([[1.0, 0, 0, -20], [0, 1, 0, -19], [0, 0, 1, -21], [0, 0, 0, 1]]))


def ellipsoid_case(semi_axes, name="e", split="train", centre=(0.0, 0.0, 0.0)):
    return Case(name, name, split, Ellipsoid(tuple(semi_axes), np.array(centre)).mask(GRID), GRID)


def ellipsoids(count, split="train", seed=0):
    axes = np.random.default_rng(seed).uniform(8.0, 14.0, (count, 3))
    return tuple(ellipsoid_case(row, f"{split}{n}", split) for n, row in enumerate(axes))


@pytest.fixture(scope="module")
def modes():
    return learn_modes(ellipsoids(24), 10.0)


def drawing_of(case, regime):
    drawing = for_evaluation(case.mask, case.grid, regime)
    return in_one_stack(drawing)


def test_distance_is_exact_beside_a_plane():
    mask = np.zeros((8, 4, 4), bool)
    mask[:4] = True
    found = signed_distance(mask, np.array([2.0, 2.0, 2.0]))[:, 2, 2]
    np.testing.assert_allclose(found[1:], [5.0, 3.0, 1.0, -1.0, -3.0, -5.0, -7.0][: len(found) - 1], atol=2.1)
    np.testing.assert_allclose(found[3:], [1.0, -1.0, -3.0, -5.0, -7.0])


def test_modes_explain_more_with_each(modes):
    assert (np.diff(modes.shares) > 0).all()
    assert modes.shares[-1] <= 1.0 + 1e-9
    norms = np.linalg.norm(modes.modes, axis=0)
    assert (np.diff(norms) <= 1e-3 * norms[0]).all()
    gram = modes.modes.T @ modes.modes
    np.testing.assert_allclose(gram - np.diag(np.diag(gram)), 0.0, atol=1e-3 * gram[0, 0])


def test_reduced_reaches_its_share_with_the_fewest(modes):
    few = modes.reduced(0.9)
    assert few.shares[-1] >= 0.9
    assert len(few.shares) == 1 or few.shares[-2] < 0.9


def test_samples_are_those_of_a_linear_field(modes):
    points = np.random.default_rng(1).uniform(-9.0, 9.0, (50, 3))
    slope = np.array([[0.5, -1.0, 2.0], [1.0, 0.0, -0.5]])
    values = modes.grid.centres() @ slope.T
    found, gradient = sampled(values, np.array([2.0, -1.0]), modes.grid, points)
    np.testing.assert_allclose(found, points @ slope.T, atol=1e-9)
    np.testing.assert_allclose(gradient, np.broadcast_to([2.0, -1.0] @ slope, (50, 3)), atol=1e-9)


def test_beyond_the_grid_the_field_is_constant(modes):
    values = modes.grid.centres()[:, :1]
    far = np.array([[500.0, 0.0, 0.0], [600.0, 0.0, 0.0]])
    found, gradient = sampled(values, np.ones(1), modes.grid, far)
    assert found[0] == found[1]
    np.testing.assert_allclose(gradient[:, 0], 0.0)


@pytest.mark.parametrize("regime", ["thin", "orthogonal", "planes"])
def test_a_member_of_the_training_span_comes_back(modes, regime):
    count = modes.modes.shape[1]
    coefficients = np.random.default_rng(3).normal(size=count) * np.linspace(1.0, 0.2, count)
    offset = np.array([2.0, -1.0, 1.5])
    mask = filled(modes, ModeFit(coefficients, Pose(offset), 0), GRID)
    case = Case("member", "member", "test", mask, GRID)
    drawing = random_planes(case, 5) if regime == "planes" else drawing_of(case, regime)
    found = fit_modes(modes, drawing.stacks, drawing.planes, FitSettings(precision=1.0))
    assert dice(mask, filled(modes, found, GRID)) > 0.96


def test_a_new_ellipsoid_is_found_and_pose_follows(modes):
    case = ellipsoid_case((9.5, 12.0, 11.0), centre=(3.0, -2.0, 2.5))
    drawing = drawing_of(case, "orthogonal")
    found = fit_modes(modes, drawing.stacks, drawing.planes, FitSettings())
    assert dice(case.mask, filled(modes, found, GRID)) > 0.94
    np.testing.assert_allclose(found.pose.position, (3.0, -2.0, 2.5), atol=1.0)


def test_files_give_back_what_was_written(modes, tmp_path):
    modes.save(tmp_path / "m.npz")
    found = DistanceModes.load(tmp_path / "m.npz")
    for name in ("mean", "modes", "shares"):
        np.testing.assert_array_equal(getattr(found, name), getattr(modes, name))
    assert found.grid.coincides_with(modes.grid)
    assert found.clip_mm == modes.clip_mm


def test_better_settings_score_lower(modes):
    drawn = [(case, drawing_of(case, "orthogonal")) for case in ellipsoids(2, "validation", 7)]
    assert score(modes, FitSettings(), drawn) < score(modes, FitSettings(precision=1e-6), drawn)


@pytest.mark.slow
def test_choice_is_kept_and_depends_on_the_masks(tmp_path):
    provenance = Provenance("", "", "", True)
    cohort = Cohort("e", ellipsoids(8), ellipsoids(1, "validation", 5), (), (), provenance)
    path = kept(cohort, tmp_path)
    digest, stamp = digest_of(path), path.stat().st_mtime_ns
    assert kept(cohort, tmp_path) == path
    assert (digest_of(path), path.stat().st_mtime_ns) == (digest, stamp)
    assert read_chosen(path).modes.modes.shape[1] <= 7
    assert kept(Cohort("e", ellipsoids(9), cohort.validation, (), (), provenance), tmp_path) != path


def test_spread_keeps_the_ends():
    assert spread(range(10), 3) == [0, 4, 9]
    assert spread(range(2), 5) == [0, 1]


def test_one_mask_has_no_modes():
    with pytest.raises(ValueError, match="two masks"):
        learn_modes(ellipsoids(1), 10.0)
