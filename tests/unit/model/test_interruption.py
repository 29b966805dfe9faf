"""Work that is ended from outside, wherever it is."""

import numpy as np
import pytest

from model.inference.reconstruction import Options, reconstruct
from model.inference.sampling import draw_shape
from model.interruption import interruptible
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import cube_around, drawn

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
STACKS = [drawn(Ellipsoid((14.0, 8.0, 6.0), CENTRE), cube_around(CENTRE))]


class Ended(Exception):
    """What a check raises."""


class Countdown:
    """A check that ends the work after so many evaluations."""

    def __init__(self, left: float) -> None:
        self.passed, self.left = 0, left

    def __call__(self) -> None:
        if self.passed >= self.left:
            raise Ended
        self.passed += 1


def work(kind, model):
    if kind == "sample":
        return draw_shape(model, 3).mesh
    return reconstruct(model, STACKS, Options(uncertainty=kind)).mesh


@pytest.fixture(scope="module", params=["none", "laplace", "ensemble", "sample"])
def whole(request):
    """The kind of work, what it makes, and how many evaluations that took."""
    check = Countdown(np.inf)
    return request.param, work(request.param, interruptible(MODEL, check)), check.passed


def test_the_check_changes_nothing(whole):
    kind, mesh, evaluations = whole
    assert evaluations > 3
    np.testing.assert_array_equal(work(kind, MODEL).vertices, mesh.vertices)


@pytest.mark.parametrize("share", [0.1, 0.7])
def test_work_ends_where_the_check_says(whole, share):
    kind, _, evaluations = whole
    check = Countdown(int(share * evaluations))
    with pytest.raises(Ended):
        work(kind, interruptible(MODEL, check))
    assert check.passed == check.left
