"""The benchmark of uncertainty: its sums on figures with known answers, and its sampler on an analytic posterior."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from benchmarks.uncertainty.answers import reliability
from benchmarks.uncertainty.cells import Key, Store
from benchmarks.uncertainty.command import as_markdown
from benchmarks.uncertainty.summary import (
    Line,
    auc_of,
    calibration_error,
    ideal_spearman,
    lines_of,
    planes_saved,
    spearman_of,
)
from model.inference.mask_stack import Plane
from model.inference.observations import thinned
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import cube_around, drawn, observed

RANDOM = np.random.default_rng(0)
KEY = Key("answer", "talus", "one", "thin", "abc")
CENTRE = np.array([30.0, -20.0, 50.0])


def answer(held=True, scale=1.0, vertices=4000):
    sd = RANDOM.lognormal(-1.0, 0.8, vertices)
    error = np.abs(scale * sd * RANDOM.standard_normal(vertices))
    probability = RANDOM.uniform(size=20000)
    voxels = reliability(probability, RANDOM.uniform(size=20000) < probability)
    return {
        "volume": {"held": {"0.5": held, "0.9": held}},
        "ensemble_volume": {"held": {"0.5": held, "0.9": False}},
        "voxels": {"laplace": voxels, "ensemble": voxels},
        "vertices": {
            "laplace": sd.tolist(),
            "ensemble": RANDOM.permutation(sd).tolist(),
            "refits": RANDOM.permutation(sd).tolist(),
            "error_mm": error.tolist(),
            "smooth_error_mm": error.tolist(),
        },
        "seconds": {"fit": 1.0, "laplace": 0.2, "ensemble": 6.0},
    }


def test_voxels_that_are_right_as_often_as_they_say_have_no_error():
    assert calibration_error([answer()], "laplace") < 0.02


def test_voxels_that_are_too_sure_have_their_error():
    probability = np.full(10000, 0.9)
    truth = np.arange(10000) % 10 < 6
    error = calibration_error([{"voxels": {"laplace": reliability(probability, truth)}}], "laplace")
    assert error == pytest.approx(0.3)


def test_sds_that_errors_were_drawn_from_are_ideal_and_others_are_worthless():
    found = [answer()]
    assert spearman_of(found, "laplace") == pytest.approx(ideal_spearman(found), abs=0.04)
    assert spearman_of(found, "ensemble") == pytest.approx(0.0, abs=0.06)
    assert auc_of(found, "ensemble") == pytest.approx(0.5, abs=0.12)
    assert auc_of(found, "laplace") > 0.85


def test_area_does_not_exist_without_vertices_that_are_off():
    assert np.isnan(auc_of([answer(scale=0.0)], "laplace"))


@given(st.floats(0.05, 3.0), st.integers(0, 4))
def test_a_curve_saves_nothing_over_itself_and_planes_that_it_is_ahead(last, ahead):
    random = last + np.array([2.0, 1.5, 1.0, 0.5, 0.0])
    assert planes_saved(random, random) == pytest.approx(0.0)
    advised = np.concatenate([random[ahead:], np.full(ahead, random[-1])])
    assert planes_saved(advised, random) == pytest.approx(ahead / 6.0 if ahead < 4 else 4.0 / 6.0)


def test_advice_that_never_comes_as_near_saves_less_than_nothing():
    assert planes_saved(np.array([4.0, 3.0, 2.0]), np.array([4.0, 2.0, 1.0])) < 0.0


@pytest.mark.parametrize(
    ("found", "low", "high", "reached"),
    [(0.5, 0.5, None, True), (0.4996, 0.5, None, True), (0.4, 0.5, None, False), (0.9, 0.85, 0.95, True),
     (0.96, 0.85, 0.95, False), (float("nan"), None, 1.0, False), (3.0, None, None, None)],
)  # fmt: skip
def test_a_figure_is_held_against_its_range(found, low, high, reached):
    assert Line("here", "figure", found, low, high).reached is reached


def test_the_table_says_what_was_reached():
    other = replace(KEY, regime="orthogonal")
    text = as_markdown(lines_of({KEY: answer(), other: answer(held=False)}))
    assert "### talus, thin, 1 shapes" in text
    assert "### all, 2 answers" in text
    assert "| 90 % volume intervals that hold the truth | 0.50 | 0.85 to 0.95 | **not reached** |" in text
    assert "| time of the ensemble, in fits | 6.0 | at most 8 | reached |" in text


def test_cells_are_kept_over_a_kill(tmp_path):
    store = Store(tmp_path / "cells.jsonl")
    store.append(KEY, {"asd_mm": [1.0]})
    with store.path.open("a") as stream:
        stream.write('{"key": {"kind": "ans')
    store.append(replace(KEY, subject="two"), {"asd_mm": [2.0]})
    assert {key.subject: payload["asd_mm"] for key, payload in store.read().items()} == {"one": [1.0], "two": [2.0]}


def analytic_posterior(precision):
    gold = pytest.importorskip("benchmarks.uncertainty.gold", reason="needs Pyro")
    model = replace(ellipsoid_model(), manifest=replace(ellipsoid_model().manifest, likelihood_precision=precision))
    grid = cube_around(CENTRE)
    middle = round(float(grid.to_index(CENTRE[None])[0, 0]))
    planes = (Plane(0, 2, middle - 3), Plane(0, 2, middle + 3), Plane(0, 0, middle))
    observations = observed(drawn(Ellipsoid((13.0, 9.0, 6.5), CENTRE), grid, planes), planes)
    return gold, model, gold.posterior_of(model, thinned(observations, 2, seed=0))


def test_gradient_of_the_posterior_is_that_of_its_value():
    _, _, posterior = analytic_posterior(0.5)
    for _ in range(3):
        place = RANDOM.standard_normal(len(posterior.root))
        expected = approx_fprime(place, lambda q: posterior.at(q)[0], 1e-6)
        np.testing.assert_allclose(posterior.at(place)[1], expected, atol=2e-3 * max(1.0, np.abs(expected).max()))


@given(st.tuples(*[st.floats(-2.0, 2.0)] * 3), st.tuples(*[st.floats(-1.0, 1.0)] * 3))
def test_left_jacobian_turns_steps_of_the_rotation_vector(turn, step):
    gold = pytest.importorskip("benchmarks.uncertainty.gold", reason="needs Pyro")
    small = 1e-5 * np.array(step)
    there = Rotation.from_rotvec(np.array(turn) + small) * Rotation.from_rotvec(turn).inv()
    np.testing.assert_allclose(there.as_rotvec(), gold.left_jacobian(np.array(turn)) @ small, atol=1e-8)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_laplace_agrees_with_the_sampler_where_the_posterior_is_nearly_normal():
    gold, model, posterior = analytic_posterior(0.5)
    draws = gold.sampled(posterior, 0, warm_up=100, draws=300)
    found = gold.compared(model, posterior, draws, tuple(draws[::12]))
    assert found["sd_ratio"]["laplace"] == pytest.approx(1.0, abs=0.2)
    assert found["sd_correlation"]["laplace"] > 0.8
    assert found["inside"]["0.9"] == pytest.approx(0.9, abs=0.07)
    assert found["mean_off_in_sds"] < 0.5
