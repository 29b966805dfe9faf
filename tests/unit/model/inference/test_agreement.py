"""Laws of the comparison of a reconstruction with the drawing, plane by plane."""

from dataclasses import replace

import numpy as np
import pytest

from model.inference.agreement import disagreeing_planes, plane_warnings, sections_of
from model.inference.fitting import FitOptions, fit
from model.inference.observations import Plane
from model.inference.posterior import fitted_logits
from tests.analytic_model import ellipsoid_model
from tests.analytic_shapes import Ellipsoid
from tests.drawn_shapes import ORTHOGONAL, cube_around, drawn, observed

CENTRE = np.array([30.0, -20.0, 50.0])
MODEL = ellipsoid_model()
ELLIPSOID = Ellipsoid((14.0, 8.0, 6.0), CENTRE)


def logits_of(found, observations):
    return fitted_logits(MODEL, found, observations.points)


def test_disagreement_is_one_minus_dice():
    observations = observed(drawn(ELLIPSOID, cube_around(CENTRE)))
    found = fit(MODEL, observations, FitOptions())
    shifted = replace(found, pose=replace(found.pose, position=found.pose.position + np.array([2.0, 1.0, 0.0])))
    inside = fitted_logits(MODEL, shifted, observations.points) > 0
    for section in sections_of(observations, logits_of(shifted, observations)):
        here = observations.plane_of == observations.planes.index(section.plane)
        weights, label, shape = observations.weights[here], observations.labels[here] > 0, inside[here]
        dice = 2 * weights[label & shape].sum() / (weights[label].sum() + weights[shape].sum())
        assert section.disagreement == pytest.approx(1.0 - dice)
        assert section.wrong == pytest.approx(weights[label ^ shape].sum())


def test_planes_without_observations_are_left_out():
    observations = observed(drawn(ELLIPSOID, cube_around(CENTRE)))
    found = fit(MODEL, observations, FitOptions())
    wider = replace(observations, planes=(*ORTHOGONAL, Plane(0, 2, 3), Plane(0, 2, 4)))
    sections = sections_of(wider, logits_of(found, wider))
    assert tuple(section.plane for section in sections) == ORTHOGONAL
    assert disagreeing_planes(sections) == []


def test_planes_left_out_are_named_and_not_counted():
    observations = observed(drawn(ELLIPSOID, cube_around(CENTRE)))
    logits = -10.0 * np.ones(len(observations.points))
    sections = sections_of(observations, logits, np.array([1.0, 0.0, 1.0]))
    assert disagreeing_planes(sections) == [ORTHOGONAL[0], ORTHOGONAL[2]]
    left_out, apart = plane_warnings(sections)
    assert "mask[0] axis 1 index 20 disagrees with all other planes and was left out" in left_out
    assert "mask[0] axis 0 index 20, mask[0] axis 2 index 20; do not rely" in apart
