"""Drawings of short validation shapes: which are answered, and what is said of one that cannot be."""

from dataclasses import replace

import numpy as np
import pytest

from model.errors import CohortError, InvalidMask
from model.geometry import Grid
from model.inference.mask_stack import section_of
from tests.analytic_model import ellipsoid_model
from tests.ellipsoid_cases import CASES
from training.answerable import LEAST_PLANES, answerable_cases, answerable_drawings, naming
from training.calibration import (
    calibrate,
    changed,
    drawings_of,
    with_probability_scale,
    with_share,
    with_sound_drawings,
)
from training.cohorts.cohort import Case
from training.evaluate import reconstruction_error_mm
from training.sparsify import REGIMES
from training.usual import sound_drawings

MODEL = ellipsoid_model()


def slab(slices: int, spacing=(1.0, 1.0, 4.0)) -> Case:
    """An ellipsoid on so many thick axial slices."""
    mask = np.zeros((34, 34, slices + 6), bool)
    inside = np.add.outer((np.arange(34) - 16.5) ** 2 / 144.0, (np.arange(34) - 16.5) ** 2 / 81.0) <= 1.0
    mask[:, :, 3 : 3 + slices] = inside[:, :, None]
    return Case("slab", "slab", "validation", mask, Grid(mask.shape, np.diag([*spacing, 1.0])))


@pytest.mark.parametrize("slices", [1, 2, 4, 7, 9, 12])
def test_what_is_drawn_of_short_shapes_shows_them_on_two_planes(slices):
    case = slab(slices)
    for drawings in (answerable_drawings(case, REGIMES), drawings_of(case), sound_drawings(case)):
        assert "orthogonal" in drawings
        for drawing in drawings.values():
            shown = [section_of(drawing.stacks[plane.stack].foreground, plane).any() for plane in drawing.planes]
            assert sum(shown) >= LEAST_PLANES


def test_no_slice_of_a_short_shape_is_drawn_twice():
    places = [stack.grid.affine[2, 3] for stack in sound_drawings(slab(6, (0.5, 0.5, 8.0)))["8 parallel slices"].stacks]
    assert len(places) == len(set(places)) == 6


def test_all_drawings_of_ordinary_shapes_are_answerable():
    for case in CASES:
        assert set(answerable_drawings(case, REGIMES)) == set(REGIMES)
        assert len(sound_drawings(case)) == 5
    assert answerable_cases(CASES, ("thin",)) == CASES


def test_shapes_none_of_whose_drawings_tells_anything_are_refused():
    with pytest.raises(CohortError, match="validation shapes"):
        answerable_cases([slab(1)], ("thin", "thick"))
    assert answerable_cases([slab(1), slab(4)], ("thin",))[0].mask.any(axis=(0, 1)).sum() == 4


def test_short_shapes_are_calibrated_on():
    cases = [replace(slab(3), name="three"), replace(slab(4), name="four")]
    assert calibrate(MODEL, cases).errors
    trusted = changed(with_share(MODEL, cases), discrepancy={"spread_mm": 0.6, "fidelity": 0.5})
    known = with_probability_scale(trusted, cases)
    assert with_sound_drawings(known, cases).manifest.usual["misfit_mm"] > 0.0


def test_an_error_says_of_which_shape_and_drawing_it_is():
    with (
        pytest.raises(CohortError, match=r"slab: its drawing \(thin\) .*two planes are needed"),
        naming(slab(1), "thin"),
    ):
        raise InvalidMask("two planes are needed", part="mask[0]")
    with pytest.raises(CohortError, match=r"slab: its drawing \(thin\)"):
        reconstruction_error_mm(MODEL, slab(1), "thin")
