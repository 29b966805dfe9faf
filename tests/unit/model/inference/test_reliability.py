"""What an answer says of its own reliability."""

from dataclasses import replace

import numpy as np
import pytest

from model.inference.agreement import plane_warnings
from model.inference.fitting import FitOptions, fit, searched
from model.inference.mask_stack import MaskStack, Plane
from model.inference.mesh import Mesh
from model.inference.observations import observe
from model.inference.reconstruction import Options, reconstruct
from model.inference.reliability import (
    MOST_USUAL_PLANES,
    ROUGH_SHARE,
    Figures,
    highest_usual,
    open_share,
    open_warnings,
    thickness_warnings,
    unusual_warnings,
)
from tests.analytic_model import ellipsoid_model
from tests.ellipsoid_cases import CASES, GRID
from training.perturb import cut_off, noisy, parallel, sections_of, with_wrong
from training.sparsify import for_evaluation
from training.usual import sound_answers, sound_drawings, usual_figures

PLAIN = ellipsoid_model()
USUAL = usual_figures(sound_answers(PLAIN, CASES), len(CASES))
MODEL = replace(PLAIN, manifest=replace(PLAIN.manifest, usual=USUAL))
FIVE = parallel(CASES[0].mask, GRID)


def answered(sections, model=MODEL):
    return reconstruct(model, sections.stacks, Options(annotated=sections.planes))


def ball(radius):
    """Mesh of a cube with the volume of a ball: enough for a size."""
    half = 0.5 * radius * np.cbrt(4.0 * np.pi / 3.0)
    corners = half * np.array(list(np.ndindex(2, 2, 2))) * 2.0 - half
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return Mesh(corners, np.array(faces), np.zeros_like(corners))


def test_sound_drawings_are_seldom_warned_of():
    told = [answered(drawing).warnings for case in CASES for drawing in sound_drawings(case).values()]
    above = [any("is usual" in sentence for sentence in sentences) for sentences in told]
    assert np.mean(above) <= 0.2  # one of ten drawings lies above each quantile


def test_noise_of_the_annotator_is_told():
    told = answered(noisy(FIVE, np.random.default_rng(1), sd_mm=1.5)).warnings
    assert any("the drawing is rough or contradicts itself" in sentence for sentence in told)


def test_a_rough_drawing_is_trusted_less():
    rough = noisy(FIVE, np.random.default_rng(1), sd_mm=1.5)
    trusting, wary = (answered(rough, model).state.fits[0] for model in (PLAIN, MODEL))
    ratio = np.linalg.slogdet(wary.precision)[1] - np.linalg.slogdet(trusting.precision)[1]
    assert 0.3 < ratio / (len(wary.precision) * np.log(ROUGH_SHARE)) < 1.0


def test_a_rough_drawing_is_as_typical_as_where_it_is_trusted():
    """What is usual was measured on fits that trust drawings; a wary fit keeps away from the contours on purpose."""
    misfit = {"misfit_exponent": 0.1, "misfit_mean": -0.5, "misfit_sd": 0.5}
    density = {"density_peak": 0.0, "rarity_mean": 0.0, "rarity_sd": 1e6}
    typical = {"freedom": 15.0, "slice_mean": 0.0, "slice_sd": 1.0, **misfit, **density}
    models = [replace(one, manifest=replace(one.manifest, typical=typical)) for one in (PLAIN, MODEL)]
    rough = noisy(FIVE, np.random.default_rng(1), sd_mm=1.5)
    trusting, wary = (answered(rough, model) for model in models)
    assert wary.state.fits[0].trust < trusting.state.fits[0].trust
    assert wary.typicality_percentile == pytest.approx(trusting.typicality_percentile, rel=0.02)
    assert 1.0 < wary.typicality_percentile < 99.0


def test_a_clean_drawing_is_trusted_as_much():
    trusting, wary = (answered(FIVE, model).state.fits[0] for model in (PLAIN, MODEL))
    np.testing.assert_array_equal(wary.latent, trusting.latent)


def test_a_model_that_does_not_know_what_is_usual_is_not_judged():
    assert unusual_warnings({}, Figures(5, 100.0, 100.0)) == ()
    assert highest_usual({}, "misfit", 5) == np.inf


@pytest.mark.parametrize(("name", "planes"), [("misfit", 3), ("misfit", 8), ("surface_sd", 3), ("surface_sd", 8)])
def test_figures_are_told_above_what_is_usual_for_as_many_planes(name, planes):
    highest = highest_usual(USUAL, name, planes)
    sound = Figures(planes, 0.0, 0.0)
    assert unusual_warnings(USUAL, replace(sound, **{f"{name}_mm": 0.99 * highest})) == ()
    (sentence,) = unusual_warnings(USUAL, replace(sound, **{f"{name}_mm": 1.01 * highest}))
    assert f"{highest:.2f} mm" in sentence


def test_more_planes_than_were_measured_with_are_judged_like_the_most():
    for name in ("misfit", "surface_sd"):
        assert highest_usual(USUAL, name, 60) == highest_usual(USUAL, name, MOST_USUAL_PLANES)


def test_more_planes_leave_the_surface_less_uncertain():
    assert USUAL["surface_sd_exponent"] < 0
    assert highest_usual(USUAL, "surface_sd", 8) < highest_usual(USUAL, "surface_sd", 3)


def test_contours_within_the_image_are_closed():
    assert open_share(FIVE.stacks, FIVE.planes) == 0.0
    assert open_warnings(FIVE.stacks, FIVE.planes) == ()


def test_open_share_is_the_border_s_share_of_the_contour():
    # A rectangle of 4 x 6 mm, on voxels of 2 x 1 mm, of which the first side of 4 mm lies at the border.
    labels = np.zeros((6, 9, 1), bool)
    labels[1:3, 0:6] = True
    grid = replace(GRID, shape=(6, 9, 1), affine=np.diag([2.0, 1.0, 5.0, 1.0]))
    stack = MaskStack("mask[0]", grid, labels, np.zeros_like(labels))
    assert open_share([stack], [Plane(0, 2, 0)]) == pytest.approx(4.0 / 20.0)


def test_what_was_not_looked_at_opens_a_contour_too():
    labels = np.zeros((8, 8, 1), bool)
    labels[2:6, 2:6] = True
    unseen = np.zeros_like(labels)
    unseen[:, 4:] = True
    grid = replace(GRID, shape=(8, 8, 1), affine=np.eye(4))
    stack = MaskStack("mask[0]", grid, labels, unseen)
    assert open_share([stack], [Plane(0, 2, 0)]) == pytest.approx(4.0 / 12.0)


def test_sections_cut_off_are_told():
    cut = cut_off(FIVE)
    (sentence,) = open_warnings(cut.stacks, cut.planes)
    assert "cut off by the border of an image" in sentence
    assert sentence in answered(cut).warnings


def test_thick_slices_are_told():
    thick = sections_of(for_evaluation(CASES[0].mask, GRID, "thick"))
    assert any("8.0 mm thick" in sentence for sentence in answered(thick).warnings)
    assert thickness_warnings(thick.stacks, thick.planes, ball(60.0)) == ()  # thin for a large object
    assert thickness_warnings(FIVE.stacks, FIVE.planes, ball(1.0)) == ()  # as thick as its voxels are wide


def test_a_doubted_plane_is_named():
    (sentence,) = plane_warnings([], Plane(2, 0, 0))
    assert "mask[2] axis 0 index 0 agrees less with the others" in sentence


@pytest.mark.parametrize("wrong", [0, 2, 4])
def test_a_thorough_search_names_the_wrong_plane(wrong):
    drawn = with_wrong(FIVE, wrong, "shifted", np.random.default_rng(wrong), FIVE)
    observations = observe(drawn.stacks, drawn.planes, budget=2500, seed=0)
    found = searched(PLAIN, observations, fit(PLAIN, observations, FitOptions(robust=False)), FitOptions())
    np.testing.assert_array_equal(np.flatnonzero(found.plane_weights == 0), [wrong])
    assert searched(PLAIN, observations, found, FitOptions()) is found


def test_badly_placed_planes_leave_the_surface_uncertain():
    close = parallel(CASES[0].mask, GRID, 29).only(range(10, 15))
    told = answered(close).warnings
    assert any("uncertain by" in sentence or "rests on the population alone" in sentence for sentence in told)
