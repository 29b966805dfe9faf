"""Two kinds of codes are told from one kind, and described as they were made."""

import numpy as np
import pytest

from training.clusters import CODES_EACH, Mixture, clusters_in, folds, two_parts

SIZE = 5


def codes_of_two(count=400, apart=5.0, share=0.5, seed=0):
    """Codes of unit variance in all, in two clusters that lie ``apart`` of their SDs from each other."""
    random = np.random.default_rng(seed)
    towards = random.standard_normal(SIZE)
    towards /= np.linalg.norm(towards)
    kind = random.random(count) < share
    codes = random.standard_normal((count, SIZE)) + apart * np.outer(kind, towards)
    codes -= codes.mean(axis=0)
    return codes @ np.linalg.inv(np.linalg.cholesky(np.cov(codes.T))).T, kind


@pytest.mark.parametrize("share", [0.5, 0.25])
def test_two_kinds_are_found_and_parted(share):
    codes, kind = codes_of_two(share=share)
    found = clusters_in(codes, len(codes))
    along = codes @ found.direction
    middle = float(np.mean(found.means)) * along.std()
    assert np.linalg.norm(found.direction) == pytest.approx(1.0)
    assert max(np.mean((along > middle) == kind), np.mean((along < middle) == kind)) > 0.98
    assert sorted(found.shares) == pytest.approx(sorted([kind.mean(), 1 - kind.mean()]), abs=0.03)


def test_a_mixture_has_the_mean_and_variance_of_its_codes():
    found = clusters_in(codes_of_two()[0], 400)
    shares, means = np.array(found.shares), np.array(found.means)
    assert shares @ means == pytest.approx(0.0, abs=1e-6)
    assert shares @ means**2 + found.sd**2 == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_one_kind_is_not_parted(seed):
    assert clusters_in(np.random.default_rng(seed).standard_normal((300, SIZE)), 300) is None


def test_heavy_tails_are_not_two_kinds():
    assert clusters_in(np.random.default_rng(1).laplace(size=(300, SIZE)), 300) is None


def test_too_few_codes_do_not_tell():
    few = CODES_EACH * SIZE - 1
    codes = codes_of_two(count=few, apart=20.0)[0]
    assert clusters_in(codes, few) is None
    assert clusters_in(np.concatenate([codes, codes]), few) is None


def test_a_shape_is_left_out_with_its_mirror_image_and_every_part_has_as_many():
    fold = folds(46, 23)
    np.testing.assert_array_equal(fold[:23], fold[23:])
    assert sorted(np.bincount(fold)) == [8, 8, 10, 10, 10]


def test_a_mixtures_density_integrates_to_one():
    codes = codes_of_two()[0][:, :1]
    grid = np.linspace(-8.0, 8.0, 4001)[:, None]
    density = np.exp(two_parts(codes).log_density(grid))
    assert np.trapezoid(density, grid[:, 0]) == pytest.approx(1.0, abs=1e-6)


def test_one_part_is_the_gaussian_of_the_codes():
    codes = codes_of_two()[0]
    one = Mixture.of(codes, np.ones((len(codes), 1)))
    np.testing.assert_allclose(one.means[0], codes.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(one.covariance, np.cov(codes.T, bias=True), atol=1e-12)
