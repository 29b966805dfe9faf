"""Training samples of a completion network."""

import numpy as np
import pytest

from model.geometry import CanonicalLattice, Grid
from tests.analytic_shapes import Ellipsoid
from training.cohorts.cohort import Case
from training.completion.drawings import random_drawing
from training.completion.samples import lattice_for, random_sample, windows_of

AFFINE = np.diag([1.0, 1.0, 1.5, 1.0])
AFFINE[:3, 3] = (-20.0, 5.0, 90.0)
GRID = Grid((34, 30, 24), AFFINE)
CENTRE = GRID.to_world(np.array([[16.0, 14.0, 11.0]]))[0]
SHAPE = Ellipsoid((11.0, 8.0, 12.0), CENTRE)
LATTICE = CanonicalLattice((24, 24, 32), 1.2)
(WINDOW,) = windows_of([Case("one", "a", "train", SHAPE.mask(GRID), GRID)])


@pytest.mark.parametrize("seed", range(24))
def test_drawings_of_all_kinds_show_the_mask_on_their_planes(seed):
    drawn = random_drawing(WINDOW, np.random.default_rng(seed))
    assert drawn.planes
    for plane in drawn.planes:
        stack = drawn.stacks[plane.stack]
        index = np.argwhere(np.ones(stack.grid.shape, bool))
        index = index[index[:, plane.axis] == plane.index]
        gap = SHAPE.logits(stack.grid.to_world(index.astype(float)))
        labels = stack.foreground[tuple(index.T)]
        clear = np.abs(gap) > 3.5
        assert (labels[clear] == (gap[clear] > 0)).all()


@pytest.mark.parametrize("seed", range(12))
def test_what_was_drawn_agrees_with_the_occupancy_there(seed):
    sample = random_sample(WINDOW, LATTICE, np.random.default_rng(seed))
    inside, outside = sample.drawn
    assert inside.any()
    assert not (inside & outside).any()
    assert sample.inside[inside & sample.known].mean() > 0.75
    assert sample.inside[outside & sample.known].mean() < 0.15


def test_samples_vary_in_place_and_shape_around_the_mask_and_are_functions_of_their_stream():
    one, again, other = (random_sample(WINDOW, LATTICE, np.random.default_rng(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.inside, again.inside)
    np.testing.assert_array_equal(one.drawn, again.drawn)
    assert (one.inside != other.inside).any()
    volumes = [random_sample(WINDOW, LATTICE, np.random.default_rng(n)).inside.sum() * 1.2**3 / 1e3 for n in range(20)]
    assert np.mean(volumes) == pytest.approx(SHAPE.volume_ml, rel=0.1)
    assert np.std(volumes) > 0.02 * SHAPE.volume_ml


def test_a_mirrored_sample_is_the_mirror_image():
    """The same stream, left for right: places along R change sign, up to the shape's own bending."""
    bent = SHAPE.mask(GRID).copy()
    bent[17:, 14:] = False
    (window,) = windows_of([Case("bent", "a", "train", bent, GRID)])
    plain, turned = (
        np.mean(
            [random_sample(window, LATTICE, np.random.default_rng(n), mirrored=m).inside for n in range(12)], axis=0
        )
        for m in (False, True)
    )
    assert np.abs(plain[::-1] - turned).mean() < 0.5 * np.abs(plain - turned).mean()


def test_beyond_a_face_that_cuts_the_object_off_nothing_is_known():
    grid = Grid((16, 30, 24), AFFINE)
    case = Case("cut", "a", "train", SHAPE.mask(GRID)[:16], grid)
    cut = windows_of([case, Case("whole", "b", "train", SHAPE.mask(GRID), GRID)])[0]
    assert not windows_of([case])[0].unknown.any()  # where most are cut, the cut is the end
    sample = random_sample(cut, LATTICE, np.random.default_rng(0))
    assert 0.2 < np.mean(~sample.known) < 0.8
    assert sample.inside[~sample.known].max() <= 0.5


def test_the_lattice_is_the_finest_that_holds_most_shapes():
    cases = [
        Case(f"{n}", f"{n}", "train", Ellipsoid((8.0 + 0.1 * n, 7.0, 10.0), CENTRE).mask(GRID), GRID) for n in range(20)
    ]
    windows = windows_of(cases)
    found = lattice_for(windows, 30_000, 0.5, 8)
    assert all(count % 8 == 0 for count in found.voxels)
    assert np.prod(found.voxels) <= 30_000
    assert (np.array(found.voxels) * found.step_mm >= 2.0 * np.array([9.5, 7.0, 10.0])).all()
    finer = lattice_for(windows, 60_000, 0.5, 8)
    assert finer.step_mm < found.step_mm
    assert lattice_for(windows, 10**9, 1.0, 8).step_mm == 1.0
