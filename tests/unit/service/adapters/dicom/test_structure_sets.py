"""Contours of a plane are put together as their type says, and none is lost without a word."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydicom import Dataset
from pydicom.sequence import Sequence as Items
from pydicom.uid import generate_uid

from model.errors import InvalidGeometry, InvalidMask, InvalidParameter, TooLarge, UnreadableImage
from service.adapters.dicom import contours, plane_groups
from service.adapters.dicom.masks import drawn_labels, frame_of_reference, referenced_series, stacks_of_object
from service.adapters.dicom.series import series_of
from service.adapters.images import ImageLimits
from tests.dicom_parts import mr_series, name_images, reread, ring, rtstruct_of, seg_of, with_region

LIMITS = ImageLimits(max_bytes=1 << 24, max_voxels=1 << 22)
PLANE = 12


@pytest.fixture(scope="module")
def images():
    return mr_series()


def square(images, radius, shift=(0.0, 0.0), number=PLANE):
    """A square (half side, mm) around the middle of an image, shifted along its rows and columns."""
    return ring(images, number, (radius,))[0] + np.array([*shift, 0.0])


def filled(images, contours, kind="CLOSED_PLANAR", number=PLANE, **more):
    """Pixels of one plane that contours draw on the images' grid."""
    found = rtstruct_of(images, [(kind, points) for points in contours])
    (stack,) = stacks_of_object(reread(found), "mask[0]", LIMITS, home=series_of(images).grid, **more)
    return stack.foreground[:, :, number]


@pytest.mark.parametrize("kind", ["CLOSED_PLANAR", "CLOSEDPLANAR_XOR"])
@pytest.mark.parametrize(
    "again",
    [
        lambda points: points,
        lambda points: points[::-1],
        lambda points: np.roll(points, 2, axis=0),
        lambda points: np.concatenate([points, points[:1]]),
    ],
    ids=["the same", "the other way", "from another point", "with its first point at the end"],
)
def test_a_contour_that_comes_twice_counts_once(images, kind, again):
    outer, inner = square(images, 7.0), square(images, 3.0)
    once = filled(images, [outer, inner], kind)
    assert once.sum() == 14**2 - 6**2
    assert (filled(images, [outer, inner, again(outer), again(inner)], kind) == once).all()


def test_a_contour_that_comes_twice_with_other_digits_counts_once(images):
    circle = np.stack([*(6.5 * f(np.linspace(0, 2 * np.pi, 60)[:-1]) for f in (np.cos, np.sin)), np.zeros(59)], axis=1)
    circle = circle + square(images, 1.0).mean(axis=0)
    once = filled(images, [circle])
    for digits in (1, 2):
        both = filled(images, [circle, np.round(circle, digits)])
        assert both[once].all()
        assert both.sum() <= once.sum() + 12


def test_contours_that_overlap_are_united(images):
    two = [square(images, 5.0), square(images, 5.0, (7.0, 0.0))]
    assert filled(images, two).sum() == 10 * 17
    assert filled(images, two, "CLOSEDPLANAR_XOR").sum() == 2 * 7 * 10


def test_contours_within_others_are_holes_and_islands(images):
    nested = [square(images, radius) for radius in (9.0, 6.0, 3.0)]
    expected = 18**2 - 12**2 + 6**2
    for order in ([0, 1, 2], [2, 1, 0], [1, 0, 2]):
        contours = [nested[number] for number in order]
        assert filled(images, contours).sum() == expected
        assert (filled(images, contours) == filled(images, contours, "CLOSEDPLANAR_XOR")).all()


def test_holes_that_overlap_are_one_hole(images):
    holes = [square(images, 2.0), square(images, 2.0, (3.0, 0.0))]
    assert filled(images, [square(images, 9.0), *holes]).sum() == 18**2 - 4 * 7


def test_a_hole_where_contours_overlap_is_a_hole(images):
    two = [square(images, 6.0), square(images, 5.0, (5.0, 0.0))]
    whole = filled(images, two)
    assert filled(images, [*two, square(images, 1.0, (3.0, 0.0))]).sum() == whole.sum() - 4


def test_an_xor_contour_takes_away_from_a_plain_one(images):
    kinds = [("CLOSED_PLANAR", square(images, 7.0)), ("CLOSEDPLANAR_XOR", square(images, 3.0))]
    home = series_of(images).grid
    (stack,) = stacks_of_object(reread(rtstruct_of(images, kinds)), "mask[0]", LIMITS, home=home)
    assert stack.foreground.sum() == 14**2 - 6**2


def test_a_contour_smaller_than_a_pixel_stands_for_one(images):
    middle = square(images, 1.0).mean(axis=0)
    speck = filled(images, [square(images, 5.0, number=8), middle + 0.2 * (square(images, 1.0) - middle)])
    assert speck.sum() == 1
    index = series_of(images).grid.to_index(np.array([[-1.0, -1.0, 1.0]]) * middle)[0]
    assert np.argwhere(speck)[0].tolist() == np.rint(index[:2]).astype(int).tolist()
    around = [square(images, 5.0), middle + 0.2 * (square(images, 1.0) - middle)]
    assert filled(images, around).sum() == 10**2


def test_a_contour_beside_the_images_is_refused(images):
    with pytest.raises(InvalidGeometry, match="contour of region 1 beside the images; contours on them are accepted"):
        filled(images, [square(images, 5.0), square(images, 3.0, (80.0, 0.0))])


SLIVERS = {
    "on a line": [(0.0, 0.0), (2.0, 0.0), (4.0, 0.0)],
    "on a slanting line": [(0.0, 0.0), (1.37, 0.411), (2.74, 0.822), (4.11, 1.2330001)],
    "of one point": [(1.0, 1.0)] * 3,
    "of one point far away": [(1000.0, 1.0)] * 4,
    "there and back": [(0.0, 0.0), (4.0, 1.0), (6.0, 3.0), (4.0, 1.0)],
    "a figure of eight": [(0.0, 0.0), (3.0, 3.0), (3.0, 0.0), (0.0, 3.0)],
}


@pytest.fixture(params=SLIVERS, ids=list(SLIVERS))
def sliver(request, images):
    return square(images, 5.0)[:1] + np.array([(*point, 0.0) for point in SLIVERS[request.param]])


@pytest.mark.parametrize("kind", ["CLOSED_PLANAR", "CLOSEDPLANAR_XOR"])
def test_a_contour_without_an_area_is_passed_over(images, sliver, kind):
    alone = filled(images, [square(images, 5.0)], kind)
    assert (filled(images, [sliver, square(images, 5.0)], kind) == alone).all()


def test_a_region_of_contours_without_an_area_draws_nothing(images, sliver):
    empty = rtstruct_of(images, [("CLOSED_PLANAR", sliver)])
    both = with_region(rtstruct_of(images, [("CLOSED_PLANAR", square(images, 5.0))]), empty, number=7)
    assert drawn_labels(both, "mask[0]") == {1}
    said = "mask[0] holds no closed planar contour around an area of region {}; one or more are needed"
    for found, labels, number in ((both, frozenset({7}), 7), (empty, None, 1)):
        with pytest.raises(InvalidMask) as caught:
            stacks_of_object(found, "mask[0]", LIMITS, labels)
        assert str(caught.value) == said.format(number)


def test_a_contour_smaller_than_a_pixel_has_an_area(images):
    tiny = square(images, 0.002)
    assert filled(images, [square(images, 5.0, number=8), tiny]).sum() == 1


@given(st.lists(st.floats(0.3, 60.0), min_size=1, max_size=5))
@settings(deadline=None, max_examples=25)
def test_contours_at_any_distances_lie_where_they_were_drawn(gaps):
    images = mr_series((36, 30, 2))
    heights = np.round(np.cumsum([-20.0, *gaps]), 3)
    base = np.round(square(images, 6.0, number=0), 3)
    drawn = [("CLOSED_PLANAR", np.column_stack([base[:, :2], np.full(4, height)])) for height in heights]
    stacks = stacks_of_object(reread(rtstruct_of(images, drawn)), "mask[0]", LIMITS)
    found = []
    for stack in stacks:
        places = np.argwhere(stack.foreground.any(axis=(0, 1))).astype(float)
        found += stack.grid.to_world(np.pad(places, ((0, 0), (2, 0))))[:, 2].tolist()
    assert sorted(found) == pytest.approx(heights, abs=0.021)


def test_regions_that_are_not_there_are_named(images):
    found = rtstruct_of(images, [("CLOSED_PLANAR", square(images, 5.0))])
    with pytest.raises(InvalidMask, match=r"has no region 98, 99; regions that are there: 1$"):
        stacks_of_object(found, "mask[0]", LIMITS, frozenset({1, 98, 99}))
    with pytest.raises(InvalidParameter, match="label 255"):
        stacks_of_object(found, "mask[0]", LIMITS, frozenset({255}))


def test_regions_without_contours_add_nothing(images):
    found = rtstruct_of(images, [("CLOSED_PLANAR", square(images, 5.0))])
    points = rtstruct_of(images, [("POINT", square(images, 5.0)[:1]), ("OPEN_PLANAR", square(images, 9.0))])
    both = with_region(found, points)
    home = series_of(images).grid
    expected = stacks_of_object(found, "mask[0]", LIMITS, home=home)[0].foreground
    for labels in (None, frozenset({1, 2})):
        (stack,) = stacks_of_object(both, "mask[0]", LIMITS, labels, home)
        assert (stack.foreground == expected).all()
    with pytest.raises(InvalidMask, match="no closed planar contour"):
        stacks_of_object(both, "mask[0]", LIMITS, frozenset({2}))


def test_contours_of_a_region_that_is_listed_twice_all_count(images):
    found = rtstruct_of(images, [("CLOSED_PLANAR", square(images, 5.0))])
    other = rtstruct_of(images, [("CLOSED_PLANAR", square(images, 5.0, number=15))])
    both = with_region(found, other, number=1)
    (stack,) = stacks_of_object(both, "mask[0]", LIMITS, home=series_of(images).grid)
    assert np.flatnonzero(stack.foreground.any(axis=(0, 1))).tolist() == [PLANE, 15]


def test_contours_that_are_slightly_off_their_plane_lie_in_it(images):
    at_heights = [square(images, 7.0, number=number) for number in (8, 12, 16)]
    off = square(images, 3.0, (9.0, 0.0)) + np.array([0.0, 0.0, 0.12])
    found = rtstruct_of(images, [("CLOSED_PLANAR", points) for points in (*at_heights, off)])
    (stack,) = stacks_of_object(reread(found), "mask[0]", LIMITS)
    places = np.flatnonzero(stack.foreground.any(axis=(0, 1)))
    assert np.diff(places) * stack.grid.spacing[2] == pytest.approx([4.0, 4.0])
    assert stack.foreground.size < 1 << 20


def test_thin_planes_stay_apart(images):
    thin = [("CLOSED_PLANAR", square(images, 7.0) + np.array([0.0, 0.0, 0.15 * number])) for number in range(5)]
    roomy = ImageLimits(max_bytes=1 << 24, max_voxels=1 << 23)
    (stack,) = stacks_of_object(reread(rtstruct_of(images, thin)), "mask[0]", roomy)
    assert len(np.flatnonzero(stack.foreground.any(axis=(0, 1)))) == 5


@pytest.fixture
def two_frames(images):
    """Images of another frame of reference in the same study, and a structure set with a region on each series."""
    other = mr_series(study=images[0].StudyInstanceUID)
    first, second = (rtstruct_of(some, [("CLOSED_PLANAR", square(some, 7.0))]) for some in (images, other))
    return other, with_region(first, second)


def test_regions_of_several_frames_of_reference_are_not_joined(images, two_frames):
    other, found = two_frames
    with pytest.raises(InvalidGeometry, match="draws region 1 and region 2 in different frames of reference"):
        stacks_of_object(found, "mask[0]", LIMITS)
    with pytest.raises(InvalidGeometry, match="region 1 and region 2 in different frames"):
        referenced_series(found)
    for number, some in ((1, images), (2, other)):
        labels = frozenset({number})
        assert frame_of_reference(found, "object", labels) == some[0].FrameOfReferenceUID
        assert referenced_series(found, labels) == some[0].SeriesInstanceUID
        (stack,) = stacks_of_object(found, "mask[0]", LIMITS, labels, series_of(some).grid)
        assert stack.foreground.sum() == 14**2


def test_the_series_is_that_which_the_contours_name(images):
    other = mr_series(study=images[0].StudyInstanceUID)
    found = rtstruct_of(other, [("CLOSED_PLANAR", square(other, 7.0, number=number)) for number in (8, 12, 16)])
    first = rtstruct_of(images, []).ReferencedFrameOfReferenceSequence[0]
    found.ReferencedFrameOfReferenceSequence = Items([first, found.ReferencedFrameOfReferenceSequence[0]])
    assert referenced_series(found) == other[0].SeriesInstanceUID
    name_images(found, [other[number] for number in (8, 12, 16)])
    del found.StructureSetROISequence[0].ReferencedFrameOfReferenceUID
    assert referenced_series(found) == other[0].SeriesInstanceUID
    name_images(found, [images[8], images[12], other[16]])
    assert referenced_series(found) == images[0].SeriesInstanceUID


def test_a_segmentation_on_two_series_lies_on_that_which_its_frames_name(images):
    values = np.zeros((36, 30, 26), np.uint8)
    values[10:20, 10:20, 5:9] = 1
    found = reread(seg_of(images, values))
    other = reread(seg_of(mr_series(), values)).ReferencedSeriesSequence[0]
    found.ReferencedSeriesSequence = Items([other, found.ReferencedSeriesSequence[0]])
    assert referenced_series(found) == images[0].SeriesInstanceUID


@pytest.mark.parametrize("kind", ["SEG", "RTSTRUCT"])
def test_a_drawing_in_another_frame_of_reference_than_the_images_is_refused(images, kind):
    values = np.zeros((36, 30, 26), np.uint8)
    values[10:20, 10:20, 5:9] = 1
    contours = [("CLOSED_PLANAR", square(images, 5.0))]
    found = reread(seg_of(images, values) if kind == "SEG" else rtstruct_of(images, contours))
    home = series_of(images).grid
    holder = found if kind == "SEG" else found.StructureSetROISequence[0]
    name = "FrameOfReferenceUID" if kind == "SEG" else "ReferencedFrameOfReferenceUID"
    assert frame_of_reference(found, "mask[0]") == images[0].FrameOfReferenceUID == home.frame_of_reference
    setattr(holder, name, generate_uid())
    with pytest.raises(InvalidGeometry, match="another frame of reference than that of its images") as caught:
        stacks_of_object(found, "mask[0]", LIMITS, home=home)
    assert caught.value.part == "mask[0]"
    assert stacks_of_object(found, "mask[0]", LIMITS)
    delattr(holder, name)
    assert stacks_of_object(found, "mask[0]", LIMITS, home=home)[0].grid.coincides_with(home)


def test_a_drawing_in_more_directions_than_are_accepted_is_refused(images, monkeypatch):
    turns = np.linspace(0.0, np.pi, 21, endpoint=False)
    corners = np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]])
    drawn = [
        ("CLOSED_PLANAR", corners @ np.array([[np.cos(turn), np.sin(turn), 0.0], [0.0, 0.0, 1.0]])) for turn in turns
    ]
    found, roomy = reread(rtstruct_of(images, drawn)), ImageLimits(max_bytes=1 << 24, max_voxels=1 << 26)
    monkeypatch.setattr(plane_groups, "MOST_GROUPS", 21)
    assert len(stacks_of_object(found, "mask[0]", roomy)) == 21
    monkeypatch.setattr(plane_groups, "MOST_GROUPS", 20)
    with pytest.raises(TooLarge, match="more than 20 directions"):
        stacks_of_object(found, "mask[0]", roomy)


@pytest.mark.parametrize(("name", "most"), [("MOST_CONTOURS", 1), ("MOST_OF_ONE", 3), ("MOST_POINTS", 7)])
def test_more_contours_or_points_than_are_accepted_are_refused(images, monkeypatch, name, most):
    found = reread(rtstruct_of(images, [("CLOSED_PLANAR", square(images, radius)) for radius in (3.0, 7.0)]))
    monkeypatch.setattr(contours, name, most + 1)
    assert len(stacks_of_object(found, "mask[0]", LIMITS)) == 1
    monkeypatch.setattr(contours, name, most)
    with pytest.raises(TooLarge, match="choose regions"):
        stacks_of_object(found, "mask[0]", LIMITS)
    monkeypatch.setattr(contours, name, 0)
    with pytest.raises(TooLarge, match="choose regions"):
        drawn_labels(found, "mask[0]")


@pytest.mark.parametrize(
    ("kind", "data"),
    [("POINT", None), ("OPEN_PLANAR", None), ("CLOSED_PLANAR", []), ("CLOSED_PLANAR", ["1", "2", "3"])],
)
def test_a_contour_that_holds_no_area_is_passed_over_beside_one_that_does(images, kind, data):
    found = rtstruct_of(images, [("CLOSED_PLANAR", square(images, 7.0))])
    item = Dataset()
    item.ContourGeometricType = kind
    if data is not None:
        item.ContourData = data
    found.ROIContourSequence[0].ContourSequence.append(item)
    (stack,) = stacks_of_object(reread(found), "mask[0]", LIMITS, home=series_of(images).grid)
    assert stack.foreground.sum() == 14**2


def test_a_closed_contour_without_its_data_is_damage(images):
    found = rtstruct_of(images, [("CLOSED_PLANAR", square(images, 7.0))])
    del found.ROIContourSequence[0].ContourSequence[0].ContourData
    with pytest.raises(UnreadableImage, match="damaged"):
        stacks_of_object(reread(found), "mask[0]", LIMITS)
