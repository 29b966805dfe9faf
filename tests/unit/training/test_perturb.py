"""Disturbed drawings: what each does to a drawing, and what the fit makes of it."""

import numpy as np
import pytest

from model.geometry import Grid, Pose
from model.inference.agreement import plane_warnings
from model.inference.agreement import sections_of as areas_of
from model.inference.coverage import coverage_warnings
from model.inference.fitting import FitOptions, fit
from model.inference.observations import observe
from model.inference.posterior import fitted_logits
from model.inference.surface import surface_of
from tests.analytic_model import bent_model, ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import DecodedShape, cube_around, rotation
from training.cohorts.cohort import Case
from training.metrics_masks import dice
from training.perturb import (
    DILATION_MM,
    SHIFT_MM,
    WRONG_KINDS,
    cut_off,
    moved,
    noisy,
    oblique,
    one_end,
    parallel,
    sections_of,
    tilted,
    with_wrong,
)
from training.sparsify import for_evaluation

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
GRID = cube_around(CENTRE, nodes=37)
MASK = Ellipsoid((14.5, 8.5, 7.5), CENTRE, rotation(10.0)).mask(GRID)
OTHER = Ellipsoid((11.0, 10.0, 6.0), CENTRE).mask(GRID)
FIVE, OTHERS = parallel(MASK, GRID), parallel(OTHER, GRID)
ORTHOGONAL = sections_of(for_evaluation(MASK, GRID, "orthogonal"))


def random(seed=0):
    return np.random.default_rng(seed)


def observed(sections):
    return observe(sections.stacks, sections.planes, budget=2500, seed=0)


def accuracy(sections, grid=GRID, mask=MASK, model=MODEL, **options):
    """Dice against the dense mask."""
    found = fit(model, observed(sections), FitOptions(**options))
    return dice(mask, (fitted_logits(model, found, grid.centres()) > 0).reshape(mask.shape))


def area(sections, number):
    return sections.labels(number).sum() * sections.spacing(number).prod()


def test_planes_lie_where_the_mask_has_them():
    for number, stack in enumerate(FIVE.stacks):
        inside = stack.grid.to_world(np.argwhere(stack.foreground).astype(float))
        index = np.rint(GRID.to_index(inside)).astype(int)
        assert MASK[tuple(index.T)].all()
        assert area(FIVE, number) > 0
    assert {plane.axis for plane in FIVE.planes} == {0}


def test_noise_has_its_size_and_is_smooth():
    moves = []
    for seed in range(20):
        drawn = noisy(FIVE, random(seed))
        for number in range(5):
            perimeter = 2.0 * np.sqrt(np.pi * area(FIVE, number))
            moves.append((area(drawn, number) - area(FIVE, number)) / perimeter)
    assert abs(np.mean(moves)) < 0.25
    assert 0.3 < np.std(moves) < 1.0


def test_the_same_seed_gives_the_same_drawing():
    first, second, third = (noisy(FIVE, random(seed)) for seed in (3, 3, 4))
    assert all((first.labels(n) == second.labels(n)).all() for n in range(5))
    assert any((first.labels(n) != third.labels(n)).any() for n in range(5))


def test_cut_off_planes_end_inside_and_say_nothing_beyond():
    for before, after in zip(FIVE.stacks, cut_off(FIVE).stacks, strict=True):
        ends = np.take(after.foreground, -1, axis=1)
        assert ends.any()
        assert after.foreground.sum() < before.foreground.sum()
        np.testing.assert_array_equal(after.grid.affine, before.grid.affine)


@pytest.mark.parametrize("kind", WRONG_KINDS)
def test_only_one_plane_is_wrong(kind):
    wrong = with_wrong(FIVE, 2, kind, random(), OTHERS)
    changed = [number for number in range(5) if (wrong.labels(number) != FIVE.labels(number)).any()]
    assert changed == ([] if kind == "mirrored" else [2])  # the section is its own mirror image


def test_a_shifted_plane_keeps_its_area_and_lies_as_far_off_as_said():
    for seed in range(10):
        wrong = with_wrong(FIVE, 2, "shifted", random(seed), OTHERS)
        assert area(wrong, 2) == pytest.approx(area(FIVE, 2), rel=0.1)
        move = np.argwhere(wrong.labels(2)).mean(axis=0) - np.argwhere(FIVE.labels(2)).mean(axis=0)
        assert SHIFT_MM[0] - 0.5 < np.linalg.norm(move) < SHIFT_MM[1] + 0.5


def test_a_dilated_plane_grows_by_its_border():
    radius = np.sqrt(area(FIVE, 2) / np.pi)
    grown = np.sqrt(area(with_wrong(FIVE, 2, "dilated", random(), OTHERS), 2) / np.pi)
    assert grown - radius == pytest.approx(DILATION_MM, abs=0.4)


def test_one_end_is_the_first_third():
    drawn = one_end(MASK, GRID)
    index = np.concatenate([GRID.to_index(stack.grid.to_world(np.zeros((1, 3)))) for stack in drawn.stacks])
    held = np.flatnonzero(MASK.any(axis=(1, 2)))
    assert len(drawn.stacks) >= 2
    assert index[:, 0].min() == pytest.approx(held[0])
    assert index[:, 0].max() < held[0] + len(held) / 3 + 1


@pytest.mark.parametrize("sections", [noisy(FIVE, random()), noisy(ORTHOGONAL, random()), cut_off(FIVE)])
def test_disturbed_drawings_are_fitted_nearly_as_well(sections):
    assert accuracy(sections) > accuracy(FIVE) - 0.12  # noise of 1 mm on sections that are 7 mm in radius


@pytest.mark.parametrize("seed", range(3))
def test_oblique_planes_are_fitted(seed):
    drawn = oblique(Case("one", "one", "validation", MASK, GRID), 6, seed)
    assert accuracy(drawn) > accuracy(FIVE) - 0.03


@pytest.mark.parametrize("degrees", [0.0, 20.0, 40.0])
def test_leaning_slices_are_fitted_as_well(degrees):
    drawn = tilted(Case("one", "one", "validation", MASK, GRID), degrees)
    normals = np.array([stack.grid.affine[:3, 2] / stack.grid.spacing[2] for stack in drawn.stacks])
    leaning = np.degrees(np.arccos(np.abs(normals[:, FIVE.axes[0]])))
    np.testing.assert_allclose(leaning, degrees, atol=1e-4)
    assert all(stack.foreground.any() for stack in drawn.stacks)
    assert accuracy(drawn) > accuracy(FIVE) - 0.02


@pytest.mark.parametrize(
    ("kind", "wrong"), [("shifted", 0), ("shifted", 2), ("shifted", 3), ("dilated", 2), ("dilated", 3)]
)
def test_the_wrong_plane_is_named_alone_and_costs_nothing(kind, wrong):
    drawn = with_wrong(FIVE, wrong, kind, random(wrong), OTHERS)
    observations = observed(drawn)
    found = fit(MODEL, observations, FitOptions())
    np.testing.assert_array_equal(np.flatnonzero(found.plane_weights == 0), [wrong])
    logits = fitted_logits(MODEL, found, observations.points)
    (sentence,) = plane_warnings(areas_of(observations, logits, found.plane_weights))
    assert f"mask[{wrong}] axis 0 index 0 disagrees with all other planes" in sentence
    rest = FIVE.only([number for number in range(5) if number != wrong])
    assert accuracy(drawn) > accuracy(rest) - 0.01


@pytest.mark.parametrize("sections", [FIVE, ORTHOGONAL, cut_off(FIVE), noisy(FIVE, random())])
def test_whole_drawings_are_not_called_extrapolated(sections):
    observations = observed(sections)
    found = fit(MODEL, observations, FitOptions())
    assert coverage_warnings(observations, surface_of(MODEL, found.latent, found.pose, 1.5).vertices) == ()


def test_drawings_of_one_end_are_called_extrapolated():
    observations = observed(one_end(MASK, GRID))
    found = fit(MODEL, observations, FitOptions())
    (sentence,) = coverage_warnings(observations, surface_of(MODEL, found.latent, found.pose, 1.5).vertices)
    assert "rests on the population alone" in sentence


@pytest.mark.parametrize("degrees", [0.0, 20.0])
def test_the_drawing_may_lie_elsewhere(degrees):
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = rotation(degrees, (0.0, 1.0, 1.0)), (20.0, -20.0, 20.0)
    there = Grid(GRID.shape, affine @ GRID.affine)
    assert accuracy(moved(ORTHOGONAL, affine), there) > accuracy(ORTHOGONAL) - 0.02


def test_left_may_stand_for_right():
    model = bent_model()
    mask = DecodedShape(model, np.array([0.4, -0.2, 0.3]), Pose(CENTRE)).mask(GRID)
    drawn = sections_of(for_evaluation(mask, GRID, "orthogonal"))
    flip = np.diag([-1.0, 1.0, 1.0, 1.0])
    there = Grid(GRID.shape, flip @ GRID.affine)
    straight = accuracy(drawn, mask=mask, model=model)
    assert accuracy(moved(drawn, flip), there, mask, model, mirror="auto") > straight - 0.01
