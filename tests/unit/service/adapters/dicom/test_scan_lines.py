"""Pixels of a polygon by lines are those of a library that looks at each pixel, but for such as lie on it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from skimage.draw import polygon2mask

from service.adapters.dicom import scan_lines
from service.adapters.dicom.scan_lines import ON_EDGE, enclosed

SHAPE = (23, 17)
POLYGONS = st.integers(3, 14).flatmap(lambda corners: arrays(float, (corners, 2), elements=st.floats(-6.0, 28.0)))


def distance(polygon):
    """Of each pixel's centre from the polygon's line."""
    points = np.indices(SHAPE).reshape(2, -1).T[:, None]
    starts, ends = polygon, np.roll(polygon, -1, axis=0)
    along = ends - starts
    share = ((points - starts) * along).sum(axis=2) / np.maximum(np.square(along).sum(axis=1), 1e-300)
    nearest = starts + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(points - nearest, axis=2).min(axis=1).reshape(SHAPE)


@given(POLYGONS)
def test_pixels_away_from_the_line_are_those_of_the_library(polygon):
    away = distance(polygon) > ON_EDGE
    assert np.array_equal(enclosed(polygon, SHAPE)[away], polygon2mask(SHAPE, polygon)[away])


@given(POLYGONS, st.sampled_from([1, 2]))
def test_pixels_on_the_line_are_in_it(polygon, parts):
    polygon = np.round(polygon * parts) / parts
    assert enclosed(polygon, SHAPE)[distance(polygon) < 1e-9].all()


@given(POLYGONS, st.integers(0, 13), st.booleans())
def test_it_does_not_matter_where_a_polygon_begins_and_which_way_it_runs(polygon, start, backwards):
    again = np.roll(polygon, start, axis=0)
    same = enclosed(again[::-1] if backwards else again, SHAPE) == enclosed(polygon, SHAPE)
    assert same[distance(polygon) > ON_EDGE].all()


@pytest.mark.parametrize("shift", [(-50.0, 0.0), (50.0, 0.0), (0.0, -50.0), (0.0, 50.0)])
def test_a_polygon_beside_the_image_encloses_nothing(shift):
    square = np.array([[2.0, 2.0], [2.0, 9.0], [9.0, 9.0], [9.0, 2.0]])
    assert enclosed(square, SHAPE).sum() == 64
    assert not enclosed(square + shift, SHAPE).any()


def test_blocks_do_not_show(monkeypatch):
    turn = np.linspace(0.0, 40.0, 500)
    star = 100.0 + np.stack([np.cos(turn), np.sin(turn)], axis=1) * np.linspace(10.0, 95.0, 500)[:, None]
    whole = enclosed(star, (200, 200))
    monkeypatch.setattr(scan_lines, "BLOCK", 100)
    assert np.array_equal(enclosed(star, (200, 200)), whole)
    assert np.array_equal(whole, polygon2mask((200, 200), star))
