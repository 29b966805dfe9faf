"""A drawing that two places explain is told from one that only one place explains."""

from dataclasses import replace

import numpy as np
import pytest

from model.geometry import Pose
from model.inference.fit_types import FitOptions, Rival
from model.inference.fitting import fit
from model.inference.objective import Point
from model.inference.rivals import RIVAL_NATS, distance_mm, rival_of, rival_warnings
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import ORTHOGONAL, cube_around, drawn, observed, rotation

CENTRE = np.array([30.0, -20.0, 50.0])
LARGE = ellipsoid_model(mean_axes=(45.0, 32.0, 22.0))
SHAPE = Ellipsoid((45.0, 32.0, 22.0), CENTRE)
GRID = cube_around(CENTRE, step=2.7)


def found_from(planes):
    return fit(LARGE, observed(drawn(SHAPE, GRID, planes), planes), FitOptions())


def optimum(value, *, shift=0.0, mirrored=False):
    pose = Pose(CENTRE + np.array([shift, 0.0, 0.0]), mirrored=mirrored)
    return Point(np.zeros(3), pose, value, np.zeros(10), np.zeros((10, 10)), np.ones(3))


HALF = np.array([20.0, 16.0, 12.0])
BEST = optimum(50.0)


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ([optimum(51.0, shift=9.0)], (1.0, 9.0)),
        ([optimum(52.5, shift=4.0), optimum(51.5, shift=20.0)], (1.5, 20.0)),
        ([optimum(50.0 + RIVAL_NATS + 0.1, shift=9.0)], None),
        ([optimum(51.0, shift=2.9)], None),
        ([optimum(51.0, shift=9.0, mirrored=True)], None),
        ([], None),
    ],
)
def test_a_rival_is_nearly_as_probable_and_lies_elsewhere(others, expected):
    found = rival_of(BEST, [BEST, *others], HALF)
    assert (None if found is None else (found.nats, pytest.approx(found.distance_mm))) == expected


def test_a_rival_is_told_of():
    found = replace(found_from(ORTHOGONAL), rival=Rival(np.log(2.0), 11.2))
    assert rival_warnings(found) == (
        "A place 11 mm away explains the drawing nearly as well (1 to 2.0); a further plane would tell them apart.",
    )


def test_orthogonal_slices_have_one_explanation():
    found = found_from(ORTHOGONAL)
    assert found.rival is None
    assert rival_warnings(found) == ()


@pytest.mark.parametrize("shift", [(3.0, 0.0, 0.0), (1.0, -2.0, 2.0)])
def test_distance_of_a_shift_is_its_length(shift):
    pose = Pose(CENTRE, rotation(30.0, (1.0, 1.0, 0.0)))
    half = np.array([20.0, 15.0, 10.0])
    assert distance_mm(pose, replace(pose, position=CENTRE + shift), half) == pytest.approx(np.linalg.norm(shift))


def test_distance_of_a_turn_grows_with_the_object():
    turned = Pose(CENTRE, rotation(20.0))
    small, large = (distance_mm(Pose(CENTRE), turned, size * np.ones(3)) for size in (10.0, 20.0))
    assert large == pytest.approx(2.0 * small)
    assert small > 0.0
