"""Points in pieces give what all points at once give."""

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.chunks import CHUNK, Workers


class Recorded:
    """A network that is a formula, and what it was asked."""

    def __init__(self):
        self.sizes, self.threads = [], set()

    def __call__(self, latent, points):
        self.sizes.append(points.shape[0] * points.shape[1])
        self.threads.add(threading.get_ident())
        value = np.einsum("bd,bnk->bn", latent, points)
        return value, 2.0 * points


@given(
    shapes=st.integers(1, 40),
    points=st.sampled_from([0, 1, 7, CHUNK - 1, CHUNK, CHUNK + 1, 2 * CHUNK + 5]),
    threads=st.integers(1, 3),
)
def test_pieces_join_to_the_whole(shapes, points, threads):
    random = np.random.default_rng(points)
    latent, where = random.normal(size=(shapes, 4)), random.normal(size=(shapes, points, 3))
    network = Recorded()
    found = Workers(threads).evaluate(network, latent, where)
    single = latent.astype(np.float32), where.astype(np.float32)
    for part, expected in zip(found, Recorded()(*single), strict=True):
        np.testing.assert_allclose(part, expected, rtol=1e-5, atol=1e-5)
    assert sum(network.sizes) == shapes * points
    assert max(network.sizes) <= CHUNK


def test_one_thread_is_the_callers():
    network = Recorded()
    Workers(1).evaluate(network, np.zeros((3, 2)), np.zeros((3, 10 * CHUNK, 3)))
    assert network.threads == {threading.get_ident()}


def test_other_threads_help():
    network = Recorded()
    together = threading.Barrier(3)
    waited = set()

    def patient(latent, points):
        if len(network.sizes) > 0 and threading.get_ident() not in waited:
            waited.add(threading.get_ident())
            together.wait(timeout=20.0)
        return network(latent, points)

    Workers(3).evaluate(patient, np.zeros((1, 2)), np.zeros((1, 20 * CHUNK, 3)))
    assert len(network.threads) == 3


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_of_the_network_reaches_the_caller(threads):
    def failing(*_):
        raise ArithmeticError

    with pytest.raises(ArithmeticError):
        Workers(threads).evaluate(failing, np.zeros((1, 2)), np.zeros((1, 9 * CHUNK, 3)))
