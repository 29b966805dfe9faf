"""Trust in drawings: which candidate is taken, and that calibrating changes nothing else."""

from dataclasses import replace

import pytest

from tests.analytic_model import ellipsoid_model
from tests.ellipsoid_cases import CASES as SHAPES
from training.calibration import (
    CASES,
    FIDELITIES,
    PRECISIONS,
    Calibration,
    Trust,
    calibrate,
    changed,
    with_probability_scale,
    with_sound_drawings,
)
from training.cohorts.cohort import evenly

MODEL = ellipsoid_model()


def test_the_least_trust_of_those_that_hardly_differ_is_taken():
    errors = {Trust(0.1, 0.7): 0.0513, Trust(0.2, 0.85): 0.0501, Trust(0.2, 0.5): 0.0502, Trust(0.4, 0.3): 0.05}
    assert Calibration(errors).best == (0.2, 0.5)


def test_a_clear_winner_is_taken_whatever_its_trust():
    assert Calibration({Trust(0.1, 0.15): 0.06, Trust(0.8, 0.85): 0.05}).best == (0.8, 0.85)


def test_all_pairs_are_tried():
    told = []
    found = calibrate(MODEL, SHAPES[:1], lambda: told.append("stage"))
    assert set(found.errors) == {Trust(precision, fidelity) for precision in PRECISIONS for fidelity in FIDELITIES}
    assert all(0.0 <= error < 0.3 for error in found.errors.values())
    assert len(told) == len(PRECISIONS)


@pytest.mark.parametrize(("count", "used"), [(1, 1), (8, 8), (9, 5), (36, 8)])
def test_cases_are_spaced_evenly(count, used):
    assert len(evenly(SHAPES[:1] * count, CASES)) == used


def test_the_scale_of_probabilities_survives_the_width_of_sds():
    known = changed(MODEL, discrepancy={"spread_mm": 0.6, "fidelity": 0.5}, posterior={})
    scaled = with_probability_scale(known, SHAPES)
    assert scaled.manifest.discrepancy["fidelity"] == 0.5
    judged = with_sound_drawings(scaled, SHAPES[:1]).manifest
    assert judged.posterior["sharpness"] == scaled.manifest.posterior["sharpness"] > 0.0
    assert judged.posterior["sd_scale"] > 0.0
    assert judged.calibration["sound_cases"] == 1
    assert replace(judged, calibration={}, usual={}, typical={}, posterior={}) == replace(
        scaled.manifest, calibration={}, usual={}, typical={}, posterior={}
    )
