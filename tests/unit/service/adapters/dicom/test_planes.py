"""Series are complete stacks whatever their headers say of thickness; drawings are sparse ones."""

import highdicom as hd
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydicom import Dataset
from pydicom.sequence import Sequence as Items
from pydicom.uid import generate_uid

from model.errors import InvalidGeometry
from service.adapters.dicom.frame_planes import FramePlane
from service.adapters.dicom.masks import stacks_of_object
from service.adapters.dicom.planes import REGULAR_MM, drawn_stacks, stack_places
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


def heights_of(stacks, count):
    """Where the planes lie on the grids of their stacks (mm)."""
    found = np.full(count, np.nan)
    for stack in stacks:
        index = np.stack([np.zeros(len(stack.places)), np.zeros(len(stack.places)), stack.places], axis=1)
        found[stack.numbers] = stack.grid.to_world(index.astype(float))[:, 2]
    return found


@pytest.mark.parametrize(
    ("heights", "finest"),
    [
        ((0.0, 17.0, 34.5), 0.5),
        ((0.0, 85.0, 235.0), 5.0),
        ((0.0, 20.0, 47.0), 1.0),
        ((0.0, 21.25, 46.25), 1.25),
        ((0.0, 35.0, 71.5), 0.5),
        ((0.0, 114.0, 276.0), 6.0),
    ],
)
def test_a_step_is_as_fine_as_planes_far_apart_need_it(heights, finest):
    (stack,) = drawn_stacks(sparse(heights, 5.1), 8, 8, 1 << 22)
    assert stack.grid.spacing[2] > finest - REGULAR_MM
    assert heights_of([stack], 3) == pytest.approx(np.array(heights), abs=REGULAR_MM)


@given(
    st.lists(st.floats(0.3, 90.0), min_size=1, max_size=8),
    st.sampled_from([np.nan, 0.8, 3.0]),
    st.sampled_from([0.0, 20.0]),
    st.randoms(use_true_random=False),
)
@settings(deadline=None)
def test_planes_at_any_distances_lie_where_they_were_drawn(gaps, depth, room_mm, random):
    heights = np.cumsum([-7.3, *gaps])
    random.shuffle(heights)
    stacks = drawn_stacks(sparse(heights, depth), 40, 30, 1 << 22, room_mm)
    assert sorted(np.concatenate([stack.numbers for stack in stacks])) == list(range(len(heights)))
    assert heights_of(stacks, len(heights)) == pytest.approx(heights, abs=REGULAR_MM + 1e-6)
    assert sum(np.prod(stack.grid.shape) for stack in stacks) <= 1 << 22
    first = stacks[0].grid.to_world(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, stacks[0].grid.shape[2] - 1.0]]))[:, 2]
    assert first[0] <= heights.min() - room_mm + REGULAR_MM
    assert first[1] >= heights.max() + room_mm - REGULAR_MM


def test_planes_that_no_step_fits_are_stacks_by_themselves():
    heights = (0.0, 4.0, 4.17, 4.18, 8.31, 13.07)
    assert stack_places(sparse(heights)) is None
    stacks = drawn_stacks(sparse(heights), 8, 8, 1 << 22)
    assert [stack.numbers.tolist() for stack in stacks] == [[0], [1], [2, 3], [4], [5]]
    assert heights_of(stacks, 6) == pytest.approx(np.array(heights), abs=REGULAR_MM)
    assert [stack.grid.shape[2] for stack in stacks] == [28, 1, 1, 1, 1]
    assert stacks[0].grid.spacing[2] == pytest.approx(0.5)


def test_no_step_is_tried_that_takes_more_voxels_than_are_accepted():
    heights = (0.0, 17.0, 34.5)
    assert len(drawn_stacks(sparse(heights, 5.0), 8, 8, 8 * 8 * 80)) == 1
    stacks = drawn_stacks(sparse(heights, 5.0), 8, 8, 8 * 8 * 20)
    assert len(stacks) == 3
    assert heights_of(stacks, 3) == pytest.approx(np.array(heights))


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


def volume_of_its_own():
    """A multi-frame image whose frames lie in the coordinates of its volume, as those of ultrasound do."""
    image, frames = reread(mr_series((12, 10, 1))[0]), []
    for number in range(4):
        frame, position = Dataset(), Dataset()
        position.ImagePositionVolume = [0, 0, number]
        frame.PlanePositionVolumeSequence = Items([position])
        frames.append(frame)
    shared, orientation, measures = Dataset(), Dataset(), Dataset()
    orientation.ImageOrientationVolume, measures.PixelSpacing = [1, 0, 0, 0, 1, 0], [1, 1]
    shared.PlaneOrientationVolumeSequence, shared.PixelMeasuresSequence = Items([orientation]), Items([measures])
    image.SharedFunctionalGroupsSequence, image.PerFrameFunctionalGroupsSequence = Items([shared]), Items(frames)
    return [image]


def without_position():
    images = mr_series((12, 10, 4))
    del images[2].ImagePositionPatient
    return images


@pytest.mark.parametrize("images", [volume_of_its_own, without_position])
def test_images_without_planes_in_the_patient_are_refused(images):
    said = (
        r"^series has a frame without a plane in the patient's coordinates; frames with Image Position \(Patient\), "
        r"Image Orientation \(Patient\) and Pixel Spacing are accepted$"
    )
    with pytest.raises(InvalidGeometry, match=said):
        series_of(images())
