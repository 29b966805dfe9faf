"""What is said of drawings whose mirror image the model knows better."""

from dataclasses import replace

import numpy as np
import pytest

from model.geometry import Pose
from model.inference.fitting import FitOptions, fit
from model.inference.other_side import (
    FAR_BETTER_NATS,
    LOOKED_AT,
    nats_of_other_side,
    other_side_warnings,
    percentile_beside,
)
from model.inference.reconstruction import Options, reconstruct
from model.inference.reliability import Figures
from tests.analytic_model import bent_model, ellipsoid_model
from tests.drawn_shapes import ORTHOGONAL, DecodedShape, cube_around, drawn, observed

CENTRE = np.array([30.0, -20.0, 50.0])
MISFIT_MEAN, MISFIT_SD = -1.0, 0.2
TYPICAL = {
    "freedom": 15.0,
    "misfit_exponent": 0.0,
    "misfit_mean": MISFIT_MEAN,
    "misfit_sd": MISFIT_SD,
    "density_peak": float(-1.5 * np.log(2.0 * np.pi)),
    "rarity_mean": 1.0,
    "rarity_sd": 0.5,
    "slice_mean": 0.0,
    "slice_sd": 1.0,
}


def knowing(model):
    return replace(model, manifest=replace(model.manifest, typical=TYPICAL))


BENT, ROUND = knowing(bent_model()), knowing(ellipsoid_model())
CODE = np.array([0.5, -0.5, 0.3])


def misfit(deviation):
    return float(np.exp(MISFIT_MEAN + deviation * MISFIT_SD))


def drawing_of(model, *, mirrored):
    return observed(drawn(DecodedShape(model, CODE, Pose(CENTRE, mirrored=mirrored)), cube_around(CENTRE)))


def nats(model, *, mirrored, mirror="never", deviation=3.0):
    observations = drawing_of(model, mirrored=mirrored)
    found = fit(model, observations, FitOptions(mirror=mirror))
    return nats_of_other_side(model, observations, found, Figures(3, misfit(deviation), 0.3), mirror)


def test_the_mirror_image_of_a_chiral_shape_is_far_better():
    assert nats(BENT, mirrored=True) > FAR_BETTER_NATS
    assert nats(BENT, mirrored=False) == 0.0


def test_either_side_may_be_the_one_that_was_asked_for():
    assert nats(BENT, mirrored=False, mirror="always") > FAR_BETTER_NATS
    assert nats(BENT, mirrored=True, mirror="always") == 0.0


def test_a_symmetric_shape_has_no_other_side():
    assert nats(ROUND, mirrored=True) < 1.0


def test_a_fit_that_chose_its_side_is_not_asked_again():
    assert nats(BENT, mirrored=True, mirror="auto") == 0.0


@pytest.mark.parametrize(("deviation", "looked"), [(LOOKED_AT - 0.1, False), (LOOKED_AT + 0.1, True)])
def test_only_drawings_that_are_fitted_badly_are_looked_at(deviation, looked):
    assert (nats(BENT, mirrored=True, deviation=deviation) > 0.0) is looked


def test_models_that_do_not_know_what_is_usual_and_misfits_that_were_not_looked_at_say_nothing():
    assert nats(bent_model(), mirrored=True) == 0.0
    observations = drawing_of(BENT, mirrored=True)
    found = fit(BENT, observations, FitOptions())
    assert nats_of_other_side(BENT, observations, found, Figures(3, 0.0, 0.3), "never") == 0.0


@pytest.mark.parametrize(
    ("percentile", "better", "expected"),
    [(60.0, 0.0, 60.0), (60.0, FAR_BETTER_NATS, 60.0), (60.0, 20.0, 100.0 * np.exp(-20.0)), (1e-9, 20.0, 1e-9)],
)
def test_a_shape_of_the_other_side_is_not_typical(percentile, better, expected):
    assert percentile_beside(percentile, better) == pytest.approx(expected)


def test_the_sentence_names_the_way_out():
    assert other_side_warnings(FAR_BETTER_NATS) == ()
    (sentence,) = other_side_warnings(FAR_BETTER_NATS + 1.0)
    assert "mirror=auto" in sentence


def test_an_answer_tells_of_it_and_mirror_auto_mends_it():
    stack = drawn(DecodedShape(BENT, CODE, Pose(CENTRE, mirrored=True)), cube_around(CENTRE))
    plain, mended = (
        reconstruct(BENT, [stack], Options(annotated=ORTHOGONAL, uncertainty="none", mirror=mirror))
        for mirror in ("never", "auto")
    )
    assert any("mirror=auto" in sentence for sentence in plain.warnings)
    assert plain.typicality_percentile < 0.01
    assert not any("mirror=auto" in sentence for sentence in mended.warnings)
    assert mended.state.fits[0].pose.mirrored
