"""Steps of the solver."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.stats import ortho_group

from model.geometry import POSE_SIZE, Pose
from model.inference.descent import LONGEST_CODE_STEP, damped_step
from model.inference.objective import Point

CODE_SIZE = 5


def a_point(seed: int, gradient: float = 0.01) -> Point:
    """A point whose curvature ties code and pose to each other."""
    draw = np.random.default_rng(seed)
    half = draw.standard_normal((CODE_SIZE + POSE_SIZE, 2 * (CODE_SIZE + POSE_SIZE)))
    pull = gradient * draw.standard_normal(len(half))
    return Point(np.zeros(CODE_SIZE), Pose(), 0.0, pull, half @ half.T, np.ones(CODE_SIZE))


@pytest.mark.parametrize("damping", [0.0, 1e-2, 1.0, 1e3])
@pytest.mark.parametrize("gradient", [0.01, 1e4])
def test_a_turned_code_takes_the_same_step(damping: float, gradient: float) -> None:
    point = a_point(0, gradient)
    turn = block_diag(ortho_group.rvs(CODE_SIZE, random_state=1), np.eye(POSE_SIZE))
    turned = replace(point, gradient=turn @ point.gradient, curvature=turn @ point.curvature @ turn.T)
    assert np.allclose(damped_step(turned, damping), turn @ damped_step(point, damping), rtol=1e-6)


def test_without_damping_the_quadratic_is_at_its_lowest() -> None:
    point = a_point(2)
    assert np.allclose(point.gradient + point.curvature @ damped_step(point, 0.0), 0.0)


def test_damping_shortens() -> None:
    point = a_point(3)
    lengths = [float(np.linalg.norm(damped_step(point, damping))) for damping in (0.0, 0.1, 1.0, 10.0, 1e3)]
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[-1] < 0.01 * lengths[0]


def test_the_code_moves_by_a_bounded_step() -> None:
    point = a_point(4, gradient=1e6)
    assert np.linalg.norm(damped_step(point, 0.0)[:CODE_SIZE]) <= LONGEST_CODE_STEP * (1.0 + 1e-9)
