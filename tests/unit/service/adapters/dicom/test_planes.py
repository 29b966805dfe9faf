"""Series are complete stacks whatever their headers say of thickness; drawings are sparse ones."""

import highdicom as hd
import numpy as np
import pytest
from pydicom.uid import generate_uid

from model.errors import InvalidGeometry
from service.adapters.dicom.masks import stacks_of_object
from service.adapters.dicom.planes import FramePlane, stack_places
from service.adapters.dicom.series import series_of
from service.adapters.images import ImageLimits
from tests.dicom_parts import grid_of, mr_series, reread, ring, rtstruct_of, seg_of

LIMITS = ImageLimits(max_bytes=1 << 24, max_voxels=1 << 22)
OBLIQUE = ((0.987688, -0.045737, -0.149614), (0.0, 0.956305, -0.292372))


def thick_series(thickness, between, interval):
    images = mr_series((12, 10, 8), spacing=(1.0, 1.0, interval))
    for image in images:
        image.SliceThickness, image.SpacingBetweenSlices = thickness, between
    return images


def rounded_series(digits, planes, spacing):
    images = mr_series((16, 14, planes), spacing=spacing, directions=OBLIQUE)
    for image in images:
        image.ImagePositionPatient = [round(float(x), digits) for x in image.ImagePositionPatient]
        image.ImageOrientationPatient = [round(float(x), 6) for x in image.ImageOrientationPatient]
        image.SliceThickness = round(spacing[2], 2)
    return images


ROUNDED = {
    "three digits": (3, 60, (0.5, 0.5, 2 / 3)),
    "two digits": (2, 160, (0.5, 0.5, 1.0)),
    "two digits, thin": (2, 60, (0.5, 0.5, 2 / 3)),
}


@pytest.fixture(params=ROUNDED, ids=list(ROUNDED))
def rounded(request):
    return rounded_series(*ROUNDED[request.param]), ROUNDED[request.param][2][2]


@pytest.mark.parametrize(
    ("thickness", "between", "interval"),
    [(1.0, None, 10.0), (1.25, None, 2.5), (4.0, 1.0, 5.0), (5.0, None, 2.5), (4.0, 5.0, 5.0), (None, None, 3.0)],
)
def test_the_step_of_a_series_is_what_its_positions_say(thickness, between, interval):
    images = thick_series(thickness, between, interval)
    found = series_of(images[::-1])
    assert found.grid.coincides_with(grid_of(images))
    assert found.grid.spacing[2] == pytest.approx(interval)
    assert found.order == tuple(range(8))


def test_rounded_positions_are_a_regular_stack(rounded):
    images, step = rounded
    found = series_of(images[::-1])
    assert found.grid.shape == (16, 14, len(images))
    assert found.grid.spacing[2] == pytest.approx(step, abs=0.02 / len(images))
    assert [i.SOPInstanceUID for i in found.images] == [i.SOPInstanceUID for i in images]


def test_drawings_on_rounded_positions_lie_on_the_images(rounded):
    images, _ = rounded
    drawn = [3, 4, 11, 30, len(images) - 2]
    values = np.zeros((16, 14, len(images)), np.uint8)
    values[4:9, 3:9, drawn] = 1
    home = series_of(images).grid
    contours = [("CLOSED_PLANAR", ring(images, number, (3.0,))[0]) for number in drawn]
    for found in (seg_of(images, values), rtstruct_of(images, contours)):
        (stack,) = stacks_of_object(reread(found), "mask[0]", LIMITS, home=home)
        assert stack.grid.coincides_with(home)
        assert np.flatnonzero(stack.foreground.any(axis=(0, 1))).tolist() == drawn


def test_a_drawing_alone_on_rounded_positions_is_one_stack(rounded):
    images, step = rounded
    drawn = [3, 4, 11, 30, len(images) - 2]
    values = np.zeros((16, 14, len(images)), np.uint8)
    values[4:9, 3:9, drawn] = 1
    (stack,) = stacks_of_object(reread(seg_of(images, values)), "mask[0]", LIMITS)
    places = np.flatnonzero(stack.foreground.any(axis=(0, 1)))
    assert places.tolist() == [number - 3 for number in drawn]
    assert stack.grid.spacing[2] == pytest.approx(step, rel=1e-3)


def sparse(heights, depth=np.nan):
    return [
        FramePlane(np.array([0.0, 0.0, z]), np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), (0.5, 0.5), depth)
        for z in heights
    ]


@pytest.mark.parametrize(
    ("heights", "depth", "step"),
    [
        ((0.0, 4.0, 8.0), np.nan, 0.5),
        ((0.0, 20.0, 41.0), 1.0, 1.0),
        ((0.0, 3.0, 4.5), np.nan, 0.5),
        ((0.0, 3.2, 4.8), np.nan, 1.6),
        ((0.0, 0.015, 0.03), 0.015, 0.015),
        ((5.0, 5.0, 5.0), 2.0, 2.0),
    ],
)
def test_a_sparse_stack_has_the_nominal_step_or_a_part_of_its_smallest_distance(heights, depth, step):
    places, found = stack_places(sparse(heights, depth))
    assert found == pytest.approx(step)
    assert places * found == pytest.approx(np.array(heights) - min(heights), abs=0.02)


def test_planes_that_nearly_coincide_need_no_step_finer_than_they_are_rounded_by():
    heights = np.array([0.0, 4.0, 4.12, 8.0])
    places, step = stack_places(sparse(heights))
    assert step >= 0.1
    assert places * step == pytest.approx(heights, abs=0.1)


def moved(images, numbers, by):
    images = [reread(image) for image in images]
    for number, offset in zip(numbers, by, strict=True):
        position = np.array(images[number].ImagePositionPatient, float) + offset
        images[number].ImagePositionPatient = [round(float(x), 6) for x in position]
    return images


def turned(images, number):
    images = [reread(image) for image in images]
    images[number].ImageOrientationPatient = [1, 0, 0, 0, 0, -1]
    return images


BROKEN = {
    "tilted": (
        lambda images: moved(images, range(8), [(0.0, 0.3 * number, 0.0) for number in range(8)]),
        "its planes are shifted against each other .* tilted gantry",
    ),
    "one shifted": (lambda images: moved(images, [3], [(0.4, 0.0, 0.0)]), "plane 4 of 8 is shifted"),
    "doubled": (lambda images: [*images, reread(images[2])], "planes 3 and 4 of 9 lie at one place"),
    "missing": (lambda images: images[:3] + images[4:], "missing between planes 3 and 4 of 7"),
    "unequal": (
        lambda images: moved(images, [3], [(0.0, 0.0, 0.3)]),
        "distances of its planes vary from 0.7 to 1.3 mm",
    ),
    "several directions": (lambda images: turned(images, 7), "plane [1-8] of 8 differs .* in its direction"),
    "two echoes": (
        lambda images: images + [reread(image) for image in images],
        "planes 1 and 2, 3 and 4, 5 and 6, 7 and 8 and 4 more of 16 lie at one place",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_keeps_images_from_being_a_stack_is_said(name):
    images = mr_series((12, 10, 8))
    change, said = BROKEN[name]
    with pytest.raises(InvalidGeometry, match=f"no regular stack of planes: .*{said}.*are accepted") as caught:
        series_of(change(images))
    assert caught.value.part == "series"


def test_one_multi_frame_image_is_accepted_and_several_are_refused():
    images = mr_series((12, 10, 8))

    def converted(some, number):
        return reread(hd.legacy.LegacyConvertedEnhancedMRImage(some, series, 5, generate_uid(), number))

    series = generate_uid()
    assert series_of([converted(images, 1)]).grid.coincides_with(grid_of(images))
    with pytest.raises(InvalidGeometry, match=r"2 images, multi-frame ones among them; .* one multi-frame image"):
        series_of([converted(images[:4], 1), converted(images[4:], 2)])
    with pytest.raises(InvalidGeometry, match="multi-frame ones among them"):
        series_of([converted(images[:4], 1), *images[4:]])
