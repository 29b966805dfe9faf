import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from model.geometry import Grid
from training.sparsify import (
    EVERY,
    REGIMES,
    body_axes,
    centred_block,
    centred_offset,
    dense,
    for_evaluation,
    for_training,
    gap_for,
    largest_slices,
    orthogonal,
    random_slices,
    thick,
    thin,
)

SIZES = st.tuples(st.integers(2, 9), st.integers(2, 9), st.integers(2, 30))


@st.composite
def masks(draw):
    """A mask that is not empty on a grid whose axes lie in any of the 48 orientations."""
    shape = draw(SIZES)
    mask = draw(arrays(bool, shape))
    mask[tuple(draw(st.integers(0, size - 1)) for size in shape)] = True
    order = draw(st.permutations(range(3)))
    signs = np.array(draw(st.tuples(*[st.sampled_from([-1.0, 1.0])] * 3)))
    affine = np.eye(4)
    affine[:3, :3] = (np.eye(3) * signs * [0.7, 1.0, 2.0])[:, order]
    affine[:3, 3] = [5.0, -7.0, 11.0]
    return mask, Grid(shape, affine)


def rows(points, labels):
    """Points with labels as a set, to a micrometre."""
    return {(*np.round(point, 3).tolist(), bool(label)) for point, label in zip(points, labels, strict=True)}


def labelled_points(drawing):
    """World points and labels of all voxels that were looked at."""
    index = np.argwhere(drawing.annotated)
    return drawing.stack.grid.to_world(index.astype(float)), drawing.stack.foreground[tuple(index.T)]


def along(values, axis):
    return np.moveaxis(values, axis, 0)


@given(masks())
def test_the_axial_axis_is_the_one_that_points_up(found):
    _, grid = found
    for world, axis in enumerate(body_axes(grid)):
        assert abs(grid.directions[world, axis]) == pytest.approx(1.0)


@given(masks(), st.sampled_from(["thin", "orthogonal", "dense"]), st.integers(0, 3))
def test_drawn_planes_are_those_of_the_dense_mask_and_nothing_else_is_drawn(found, regime, seed):
    mask, grid = found
    for drawing in (for_evaluation(mask, grid, regime), for_training(mask, grid, regime, np.random.default_rng(seed))):
        seen = np.zeros(mask.shape, bool)
        for plane in drawing.planes:
            assert plane.stack == 0
            assert np.array_equal(
                along(drawing.stack.foreground, plane.axis)[plane.index], along(mask, plane.axis)[plane.index]
            )
            along(seen, plane.axis)[plane.index] = True
        assert np.array_equal(drawing.annotated, seen)
        assert not (drawing.stack.foreground & ~seen).any()
        assert drawing.stack.grid.coincides_with(grid)


@given(masks())
def test_the_eight_offsets_of_thin_slices_make_the_dense_mask(found):
    mask, grid = found
    parts = [thin(mask, grid, offset, empty_slices=True) for offset in range(EVERY)]
    assert np.array_equal(np.sum([part.annotated for part in parts], axis=0), np.ones(mask.shape))
    assert np.array_equal(np.any([part.stack.foreground for part in parts], axis=0), mask)
    assert sum(len(part.planes) for part in parts) == len(dense(mask, grid).planes)


@given(masks(), st.integers(-20, 20))
def test_thin_slices_lie_eight_apart(found, offset):
    mask, grid = found
    drawing = thin(mask, grid, offset, empty_slices=True)
    assert all((plane.index - offset) % EVERY == 0 for plane in drawing.planes)
    assert {plane.axis for plane in drawing.planes} <= {body_axes(grid)[2]}


@given(masks())
def test_thin_slices_of_an_evaluation_are_centred_in_the_object(found):
    mask, grid = found
    axis = body_axes(grid)[2]
    occupied = np.flatnonzero(along(mask, axis).any(axis=(1, 2)))
    every = gap_for(mask, axis)
    first = centred_offset(mask, axis, every)
    slices = np.arange(first, occupied[-1] + 1, every)
    before, after = first - occupied[0], occupied[-1] - slices[-1]
    assert before >= 0
    assert after - before in (0, 1)
    assert len(slices) == -(-(occupied[-1] - occupied[0] + 1) // every)
    if np.isin(slices, occupied).any():
        drawn = for_evaluation(mask, grid, "thin").planes
        assert {plane.index for plane in drawn} == {n for n in slices if n in occupied}


@given(masks(), st.integers(-20, 20))
def test_a_thick_slice_is_the_rounded_mean_of_its_block_and_stands_in_its_middle(found, offset):
    mask, grid = found
    axis = body_axes(grid)[2]
    drawing = thick(mask, grid, offset, empty_slices=True)
    slices = along(mask, axis)
    for plane in drawing.planes:
        corner = np.zeros((1, 3))
        corner[0, axis] = plane.index
        here = grid.to_index(drawing.stack.grid.to_world(corner))[0]
        assert np.allclose(np.delete(here, axis), 0.0)
        begin = here[axis] - (EVERY - 1) / 2
        assert (begin - offset) % EVERY == pytest.approx(0.0, abs=1e-6) or (begin - offset) % EVERY == pytest.approx(
            EVERY
        )
        block = slices[max(0, round(begin)) : max(0, round(begin) + EVERY)]
        expected = block.sum(axis=0) * 2 >= EVERY
        assert np.array_equal(along(drawing.stack.foreground, axis)[plane.index], expected)
    assert drawing.stack.grid.spacing[axis] == pytest.approx(EVERY * grid.spacing[axis])


@given(masks())
def test_blocks_of_one_slice_are_the_dense_mask(found):
    mask, grid = found
    one, every = thick(mask, grid, 0, every=1, empty_slices=True), dense(mask, grid)
    assert rows(*labelled_points(one)) == rows(*labelled_points(every))


@given(masks())
def test_blocks_of_an_evaluation_are_the_fewest_that_hold_the_object_and_centred_on_it(found):
    mask, _ = found
    occupied = np.flatnonzero(mask.any(axis=(0, 1)))
    first = centred_block(mask, 2)
    blocks = -(-(occupied[-1] - occupied[0] + 1) // EVERY)
    before, after = occupied[0] - first, first + blocks * EVERY - 1 - occupied[-1]
    assert before >= 0
    assert after - before in (0, 1)


@given(masks())
def test_orthogonal_slices_of_an_evaluation_are_the_largest(found):
    mask, grid = found
    indices = largest_slices(mask)
    for axis, index in enumerate(indices):
        areas = along(mask, axis).sum(axis=(1, 2))
        assert areas[index] == areas.max()
        assert not (areas[:index] == areas.max()).any()
    assert len(orthogonal(mask, grid, indices).planes) == 3


@given(masks(), st.integers(0, 100))
def test_random_orthogonal_slices_cross_the_object(found, seed):
    mask, _ = found
    for axis, index in enumerate(random_slices(mask, np.random.default_rng(seed))):
        assert along(mask, axis)[index].any()


@given(masks(), st.sampled_from(REGIMES), st.permutations(range(3)))
def test_the_order_of_index_axes_does_not_matter(found, regime, order):
    mask, grid = found
    affine = grid.affine.copy()
    affine[:3, :3] = grid.affine[:3, list(order)]
    shape = tuple(mask.shape[axis] for axis in order)
    turned = for_evaluation(mask.transpose(order), Grid(shape, affine), regime)
    assert rows(*labelled_points(turned)) == rows(*labelled_points(for_evaluation(mask, grid, regime)))


@given(masks(), st.sampled_from(REGIMES), st.integers(0, 100))
def test_training_drawings_repeat_with_their_seed(found, regime, seed):
    mask, grid = found
    one, other = (for_training(mask, grid, regime, np.random.default_rng(seed)) for _ in range(2))
    assert one.planes == other.planes
    assert np.array_equal(one.stack.foreground, other.stack.foreground)


@given(masks(), st.sampled_from(REGIMES))
def test_evaluation_counts_planes_with_foreground_only_unless_dense(found, regime):
    mask, grid = found
    drawing = for_evaluation(mask, grid, regime)
    filled = [along(drawing.stack.foreground, plane.axis)[plane.index].any() for plane in drawing.planes]
    assert all(filled) or regime == "dense"


@given(masks(), st.sampled_from(REGIMES), st.integers(0, 100))
def test_every_drawing_shows_some_of_the_object(found, regime, seed):
    mask, grid = found
    drawings = (
        for_evaluation(mask, grid, regime),
        for_evaluation(mask, grid, regime, offset=seed),
        for_training(mask, grid, regime, np.random.default_rng(seed)),
    )
    assert all(drawing.stack.foreground.any() for drawing in drawings)


@given(st.integers(1, 30), st.integers(0, 5), st.integers(0, 100))
def test_a_short_object_is_drawn_on_two_thin_slices_and_a_long_one_at_the_full_gap(count, before, seed):
    mask = np.zeros((3, 3, before + count + 2), bool)
    mask[1, 1, before : before + count] = True
    grid = Grid(mask.shape, np.eye(4))
    drawing = for_training(mask, grid, "thin", np.random.default_rng(seed))
    shown = [plane.index for plane in drawing.planes if mask[:, :, plane.index].any()]
    if count > EVERY:
        offset = int(np.random.default_rng(seed).integers(EVERY))
        assert drawing.planes == thin(mask, grid, offset, empty_slices=True).planes
    else:
        assert len(shown) >= min(2, count)
        assert gap_for(mask, 2) <= EVERY // 2


def test_thick_slices_of_a_slanted_sheet_give_way_to_thin_ones():
    mask = np.zeros((3, 40, 40), bool)
    mask[1, np.arange(40), np.arange(40)] = True
    grid = Grid(mask.shape, np.eye(4))
    for drawing in (for_evaluation(mask, grid, "thick"), for_training(mask, grid, "thick", np.random.default_rng(0))):
        assert drawing.stack.grid.coincides_with(grid)
        assert drawing.stack.foreground.sum() == 5


def test_a_fixed_offset_is_counted_from_the_grid():
    mask = np.zeros((4, 4, 40), bool)
    mask[1:3, 1:3, 5:33] = True
    planes = for_evaluation(mask, Grid(mask.shape, np.eye(4)), "thin", offset=0).planes
    assert [plane.index for plane in planes] == [8, 16, 24, 32]
