import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from training.samples import PointPool, ShapePoints

CPU = torch.device("cpu")


def shape_of(number: int, near: int, far: int) -> ShapePoints:
    """Points whose x names the shape, whose label is the sign of y, and whose z is 1 near and 0 far."""
    random = np.random.default_rng(number)
    points = random.normal(size=(near + far, 3)).astype(np.float32)
    points[:, 0] = number
    band = random.permutation(np.arange(near + far) < near)
    points[:, 2] = band
    return ShapePoints(points, points[:, 1] > 0, band)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@given(
    st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=5),
    st.integers(1, 5),
    st.integers(1, 4),
    st.integers(0, 999),
)
def test_points_come_from_the_chosen_shape_and_stratum_with_their_labels(sizes, near, far, seed):
    pool = PointPool([shape_of(number, *size) for number, size in enumerate(sizes)], CPU)
    chosen = torch.randperm(len(sizes), generator=generator(seed))
    batch = pool.draw(chosen, (near, far), generator(seed))
    assert batch.points.shape == (len(sizes), near + far, 3)
    counts = batch.weights > 0
    for row, number in enumerate(chosen.tolist()):
        has_near, has_far = (size > 0 for size in sizes[number])
        assert counts[row, :near].all() == has_near
        assert counts[row, near:].all() == has_far
    shape = batch.points[..., 0]
    assert (shape == chosen[:, None])[counts].all()
    assert (batch.labels == (batch.points[..., 1] > 0))[counts].all()
    stratum = torch.cat([torch.ones(len(sizes), near), torch.zeros(len(sizes), far)], dim=1)
    assert (batch.points[..., 2] == stratum)[counts].all()


def value(points: torch.Tensor) -> torch.Tensor:
    return torch.sin(3.0 * points[..., 1]) + 2.0 + 5.0 * points[..., 2]


@pytest.mark.parametrize("counts", [(3, 2), (1, 7), (16, 16)])
def test_weighted_sums_are_unbiased(counts):
    shapes = [shape_of(0, 40, 300), shape_of(1, 200, 30), shape_of(2, 5, 5)]
    pool, draws = PointPool(shapes, CPU), 4000
    batch = pool.draw(torch.arange(3).repeat(draws), counts, generator())
    sums = (batch.weights * value(batch.points)).sum(dim=1).reshape(draws, 3).double()
    for number, shape in enumerate(shapes):
        full = value(torch.from_numpy(shape.points)).sum().item() / shape.near.sum()
        error = sums[:, number].std().item() / draws**0.5
        assert abs(sums[:, number].mean().item() - full) < 4 * error
        assert error < 0.05 * full


def test_every_point_is_drawn():
    shape = shape_of(0, 7, 4)
    batch = PointPool([shape], CPU).draw(torch.tensor([0]), (400, 400), generator())
    assert {tuple(point) for point in batch.points[0].tolist()} == {tuple(point) for point in shape.points.tolist()}


def test_draws_are_a_pure_function_of_the_generator():
    pool = PointPool([shape_of(0, 30, 30), shape_of(1, 30, 30)], CPU)
    one, again, other = (pool.draw(torch.arange(2), (5, 5), generator(seed)) for seed in (0, 0, 1))
    assert torch.equal(one.points, again.points)
    assert not torch.equal(one.points, other.points)


@pytest.mark.parametrize(("near", "far"), [(0, 50), (50, 0)])
def test_a_shape_with_one_stratum_counts_by_its_mean(near, far):
    pool = PointPool([shape_of(0, 9, 9), shape_of(1, near, far)], CPU)
    batch = pool.draw(torch.tensor([1]), (8, 4), generator())
    assert batch.weights.sum().item() == pytest.approx(1.0)


def test_a_mirror_image_has_left_and_right_exchanged_and_undoes_itself():
    shape = shape_of(3, 5, 4)
    image = shape.reflected()
    np.testing.assert_array_equal(image.points, shape.points * [-1, 1, 1])
    np.testing.assert_array_equal(image.labels, shape.labels)
    np.testing.assert_array_equal(image.near, shape.near)
    np.testing.assert_array_equal(image.reflected().points, shape.points)
