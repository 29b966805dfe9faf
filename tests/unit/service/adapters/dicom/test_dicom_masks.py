"""A drawing means the same voxels of the world, whatever DICOM object carries it."""

import io
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from pydicom.uid import DeflatedExplicitVRLittleEndian, ExplicitVRLittleEndian, RLELossless

from model.errors import InputError, InvalidGeometry, InvalidMask, TooLarge, UnreadableImage
from model.inference.mask_stack import common_space
from model.inference.observations import Plane, find_planes
from service.adapters.dicom.masks import drawn_labels, read_dicom_mask, stacks_of_object
from service.adapters.dicom.series import series_of
from service.adapters.images import ImageLimits, read_masks
from tests.analytic_shapes import Ellipsoid
from tests.dicom_parts import file_bytes, grid_of, mr_series, reread, ring, rtstruct_of, seg_of

LIMITS = ImageLimits(max_bytes=1 << 24, max_voxels=1 << 22)
TURNED = ((0.8, 0.6, 0.0), (0.0, 0.0, -1.0))
SERIES = {
    "axial": {},
    "frames that end within a byte": {"size": (35, 31, 24)},
    "anisotropic": {"spacing": (0.7, 0.9, 3.0), "size": (40, 33, 9)},
    "oblique": {"directions": TURNED, "spacing": (0.8, 1.1, 1.5)},
}


@pytest.fixture(params=SERIES, ids=list(SERIES))
def images(request):
    return mr_series(**SERIES[request.param])


def drawing(images, every: int = 2):
    """An ellipsoid in the middle of the images, drawn on every n-th, and the images' grid."""
    grid = grid_of(images)
    centre = grid.to_world((np.array([grid.shape], float) - 1) / 2)[0]
    values = Ellipsoid((9.0, 7.0, 8.0), centre).mask(grid)
    values[:, :, np.arange(grid.shape[2]) % every != 1] = False
    return values, grid


def world_of(stack):
    """Positions (mm) of the foreground, sorted."""
    points = stack.grid.to_world(np.argwhere(stack.foreground).astype(float))
    return points[np.lexsort(np.round(points, 3).T)]


def expected(values, grid):
    points = grid.to_world(np.argwhere(values).astype(float))
    return points[np.lexsort(np.round(points, 3).T)]


@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
def test_segmentation_lies_where_it_was_drawn(images, kind):
    values, grid = drawing(images)
    soft = values.astype(float) if kind == "FRACTIONAL" else values.astype(np.uint8)
    (stack,) = stacks_of_object(reread(seg_of(images, soft, kind)), "mask[0]", LIMITS)
    assert world_of(stack) == pytest.approx(expected(values, grid), abs=1e-3)
    drawn = [p.index for p in find_planes((stack,), "auto")]
    assert len(drawn) == len(np.flatnonzero(values.any(axis=(0, 1))))
    assert not stack.excluded[:, :, drawn].any()


def test_answers_about_dicom_are_told_in_its_own_world():
    images = mr_series()
    drawn = [("CLOSED_PLANAR", ring(images, 9, (6.0,))[0]), ("CLOSED_PLANAR", ring(images, 10, (6.0,))[0])]
    segmentation, structures = (
        stacks_of_object(reread(found), "object", LIMITS)
        for found in (seg_of(images, drawing(images)[0].astype(np.uint8)), rtstruct_of(images, drawn))
    )
    plain = (replace(segmentation[0], space="RAS"),)
    for stacks, space in ((segmentation, "LPS"), (structures, "LPS"), (plain, "RAS"), (segmentation + plain, "RAS")):
        assert common_space(stacks) == space
    assert common_space(()) == "RAS"


def test_planes_without_a_frame_were_not_looked_at(images):
    values, grid = drawing(images)
    (stack,) = stacks_of_object(reread(seg_of(images, values.astype(np.uint8))), "mask[0]", LIMITS, home=grid)
    assert stack.grid.shape == grid.shape
    assert (stack.foreground == values).all()
    assert (stack.excluded.all(axis=(0, 1)) == ~values.any(axis=(0, 1))).all()


@pytest.mark.parametrize("kind", ["segmentation", "structures"])
def test_of_a_series_too_long_for_the_limit_only_the_drawn_part_is_read(kind):
    images = mr_series(size=(36, 30, 60))
    values, home = np.zeros((36, 30, 60), np.uint8), grid_of(images)
    values[12:20, 9:18, 30:42:4] = 1
    drawn = [("CLOSED_PLANAR", ring(images, number, (6.0,))[0]) for number in range(30, 42, 4)]
    found = reread(seg_of(images, values) if kind == "segmentation" else rtstruct_of(images, drawn))
    (whole,) = stacks_of_object(found, "object", LIMITS, home=home)
    (part,) = stacks_of_object(found, "object", replace(LIMITS, max_voxels=36 * 30 * 20), home=home)
    assert whole.grid.shape == home.shape
    assert part.grid.shape == (36, 30, 9)
    assert world_of(part) == pytest.approx(world_of(whole), abs=1e-6)
    with pytest.raises(TooLarge):
        stacks_of_object(found, "object", replace(LIMITS, max_voxels=36 * 30 * 8), home=home)


def test_half_of_a_fraction_is_inside(images):
    values, _ = drawing(images)
    soft = values * 0.4
    soft[values & (np.indices(values.shape)[0] % 2 == 0)] = 0.6
    (stack,) = stacks_of_object(reread(seg_of(images, soft, "FRACTIONAL")), "mask[0]", LIMITS)
    assert stack.foreground.sum() == (soft > 0.5).sum()


@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP"])
def test_a_label_is_a_segment_number(kind):
    images = mr_series()
    values, grid = drawing(images)
    left = np.indices(values.shape)[0] < values.shape[0] // 2
    both = np.stack([values & left, values & ~left], axis=-1).astype(np.uint8)
    found = reread(seg_of(images, both, kind, labels=("left", "right")))
    for label, part in ((None, values), (frozenset({1}), values & left), (frozenset({2}), values & ~left)):
        (stack,) = stacks_of_object(found, "mask[0]", LIMITS, label, grid)
        assert (stack.foreground == part).all()
    with pytest.raises(InvalidMask, match="no segment 3, 7; segments that are there: 1, 2"):
        stacks_of_object(found, "mask[0]", LIMITS, frozenset({1, 3, 7}))
    with pytest.raises(InvalidMask, match="no segment 3; segments that are there: 1, 2"):
        stacks_of_object(found, "mask[0]", LIMITS, frozenset({3}))


@pytest.mark.parametrize("labels", [None, frozenset({1})])
@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP"])
def test_a_segment_that_is_drawn_and_not_described_is_told(kind, labels):
    images = mr_series()
    values, _ = drawing(images)
    left = np.indices(values.shape)[0] < values.shape[0] // 2
    both = np.stack([values & left, values & ~left], axis=-1).astype(np.uint8)
    found = reread(seg_of(images, both, kind, labels=("left", "right")))
    found.SegmentSequence = [item for item in found.SegmentSequence if item.SegmentNumber != 2]
    with pytest.raises(InvalidMask, match=r"draws segment 2, which it does not describe; segments that are there: 1$"):
        stacks_of_object(found, "mask[0]", LIMITS, labels)


def with_empty_segment(images, kind):
    """A drawing of two segments of which the second has frames and no voxel, and what the first draws."""
    values, grid = drawing(images)
    both = np.stack([values, np.zeros_like(values)], axis=-1)
    if kind == "FRACTIONAL":
        both = both * 0.9
        both[values, 1] = 0.3
    else:
        both = both.astype(np.uint8)
    return reread(seg_of(images, both, kind, labels=("left", "right"), omit_empty_frames=False)), values, grid


@pytest.mark.parametrize("kind", ["BINARY", "FRACTIONAL", "LABELMAP"])
def test_segments_without_a_voxel_draw_nothing(kind):
    found, values, grid = with_empty_segment(mr_series(), kind)
    assert drawn_labels(found, "mask[0]") == {1}
    (stack,) = stacks_of_object(found, "mask[0]", LIMITS, home=grid)
    assert (stack.foreground == values).all()
    with pytest.raises(InvalidMask, match="draws nothing"):
        stacks_of_object(found, "mask[0]", LIMITS, frozenset({2}))


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, RLELossless])
@pytest.mark.parametrize("kind", ["FRACTIONAL", "LABELMAP"])
def test_drawn_segments_are_found_in_packed_pixels_too(kind, syntax):
    images = mr_series()
    values, _ = drawing(images)
    side = np.indices(values.shape)[0] // 18
    every = np.stack([values & (side == 1), values & (side == 2), values & (side == 0)], axis=-1)
    every = every.astype(float if kind == "FRACTIONAL" else np.uint8)
    found = seg_of(images, every, kind, labels=("right", "none", "left"), transfer_syntax_uid=syntax)
    assert drawn_labels(reread(found), "mask[0]") == {1, 3}


def test_planes_in_several_directions_become_several_stacks():
    axial = mr_series(origin=(0.0, 0.0, 0.0))
    values, _ = drawing(axial)
    found = reread(seg_of(axial, values.astype(np.uint8)))
    frames = found.PerFrameFunctionalGroupsSequence
    shared = found.SharedFunctionalGroupsSequence[0]
    for number, frame in enumerate(frames):
        orientation = reread(found).SharedFunctionalGroupsSequence[0].PlaneOrientationSequence
        if number % 2:
            orientation[0].ImageOrientationPatient = [1, 0, 0, 0, 0, -1]
            frame.PlanePositionSequence[0].ImagePositionPatient = [0, 4.0 + 3 * number, 26]
        frame.PlaneOrientationSequence = orientation
    del shared.PlaneOrientationSequence
    stacks = stacks_of_object(found, "mask[0]", LIMITS)
    assert len(stacks) == 2
    assert len(find_planes(stacks, "auto")) == len(frames)
    assert abs(stacks[0].grid.directions[:, 2] @ stacks[1].grid.directions[:, 2]) == pytest.approx(0, abs=1e-9)
    corner = np.argwhere(stacks[1].foreground)[0]
    assert stacks[1].grid.to_world(corner[None].astype(float))[0][2] == pytest.approx(26.0 - corner[1])


def test_drawing_across_the_frames_keeps_the_frames_around_it():
    images = mr_series()
    grid = grid_of(images)
    values = Ellipsoid((9.0, 7.0, 8.0), grid.to_world((np.array([grid.shape], float) - 1) / 2)[0]).mask(grid)
    crossed = np.zeros_like(values)
    crossed[18], crossed[:, 15] = values[18], values[:, 15]
    (stack,) = stacks_of_object(reread(seg_of(images, crossed.astype(np.uint8))), "mask[0]", LIMITS, home=grid)
    assert not stack.excluded.any()
    assert find_planes((stack,), "auto") == (Plane(0, 0, 18), Plane(0, 1, 15))


def test_holes_by_keyhole_and_by_xor_are_the_same_holes():
    images = mr_series(directions=TURNED)
    xor, keyhole = [], []
    for number in (3, 9, 15):
        outer, inner = ring(images, number, (9.0, 4.0))
        xor += [("CLOSEDPLANAR_XOR", outer), ("CLOSEDPLANAR_XOR", inner)]
        channel = np.concatenate([outer, outer[:1], inner[:1], inner[::-1], outer[:1]])
        keyhole.append(("CLOSED_PLANAR", channel))
    home = grid_of(images)
    (one,) = stacks_of_object(reread(rtstruct_of(images, xor)), "mask[0]", LIMITS, home=home)
    (other,) = stacks_of_object(reread(rtstruct_of(images, keyhole)), "mask[0]", LIMITS, home=home)
    assert (one.foreground == other.foreground).all()
    assert one.foreground.sum() == pytest.approx(3 * (18**2 - 8**2), rel=0.02)
    assert not one.foreground[15, 12, 3]


def test_contours_enclose_their_area_without_the_images(images):
    contours = [("CLOSED_PLANAR", ring(images, number, (8.0,))[0]) for number in (2, 4, 8)]
    (stack,) = stacks_of_object(reread(rtstruct_of(images, contours)), "mask[0]", LIMITS)
    planes = find_planes((stack,), "auto")
    assert len(planes) == 3
    for plane in planes:
        area = stack.foreground[:, :, plane.index].sum() * stack.grid.spacing[:2].prod()
        assert np.sqrt(area) == pytest.approx(16.0, abs=stack.grid.spacing[:2].max())
    gaps = np.diff([plane.index for plane in planes]) * stack.grid.spacing[2]
    step = np.linalg.norm(grid_of(images).affine[:3, 2])
    assert sorted(gaps) == pytest.approx([2 * step, 4 * step], rel=1e-3)


def test_contours_in_several_directions_become_several_stacks():
    axial = mr_series(origin=(0.0, 0.0, 0.0))
    flat = [("CLOSED_PLANAR", ring(axial, number, (6.0,))[0]) for number in (10, 14)]
    upright = [("CLOSED_PLANAR", contour[:, [0, 2, 1]] + [0.0, 0.0, 0.0]) for _, contour in flat]
    stacks = stacks_of_object(reread(rtstruct_of(axial, flat + upright)), "mask[0]", LIMITS)
    assert len(stacks) == 2
    assert len(find_planes(stacks, "auto")) == 4


def test_open_or_bent_contours_are_refused():
    images = mr_series()
    (contour,) = ring(images, 3, (8.0,))
    with pytest.raises(InvalidMask, match="no closed planar contour"):
        stacks_of_object(rtstruct_of(images, [("OPEN_PLANAR", contour)]), "mask[0]", LIMITS)
    contour[0, 2] += 3.0
    with pytest.raises(InvalidGeometry, match="does not lie in a plane"):
        stacks_of_object(rtstruct_of(images, [("CLOSED_PLANAR", contour)]), "mask[0]", LIMITS)


def test_run_length_encoding_changes_nothing():
    images = mr_series()
    values, _ = drawing(images)
    plain = seg_of(images, values.astype(np.uint8), "LABELMAP")
    packed = seg_of(images, values.astype(np.uint8), "LABELMAP", transfer_syntax_uid=RLELossless)
    (one,), (other,) = (stacks_of_object(reread(found), "mask[0]", LIMITS) for found in (plain, packed))
    assert (one.foreground == other.foreground).all()


def test_the_interface_reads_dicom_like_other_masks():
    images = mr_series()
    values, grid = drawing(images)
    (stack,) = read_masks(file_bytes(seg_of(images, values.astype(np.uint8))), "mask[0]", LIMITS)
    assert world_of(stack) == pytest.approx(expected(values, grid), abs=1e-3)


def test_sizes_are_refused_before_pixels_are_decoded():
    images = mr_series()
    values, _ = drawing(images)
    data = file_bytes(seg_of(images, values.astype(np.uint8)))
    few = ImageLimits(max_bytes=1 << 24, max_voxels=1000)
    with pytest.raises(TooLarge):
        read_masks(data, "mask[0]", few)
    frames = reread(seg_of(images, values.astype(np.uint8)))
    frames.PerFrameFunctionalGroupsSequence[0].PlanePositionSequence[0].ImagePositionPatient[2] = -1e7
    with pytest.raises(TooLarge):
        stacks_of_object(frames, "mask[0]", LIMITS)


def test_other_objects_are_refused():
    image = mr_series()[0]
    with pytest.raises(UnreadableImage, match="another kind"):
        read_masks(file_bytes(image), "mask[0]", LIMITS)
    image.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    with pytest.raises(UnreadableImage, match="transfer syntax"):
        read_dicom_mask(io.BytesIO(file_bytes(image)), "mask[0]", LIMITS)


@pytest.mark.parametrize("seed", range(30))
def test_damaged_objects_are_refused_or_read(seed):
    images = mr_series(size=(12, 10, 8))
    data = bytearray(file_bytes(seg_of(images, np.ones((12, 10, 8), np.uint8))))
    rng = np.random.default_rng(seed)
    for place in rng.integers(132, len(data), 12):
        data[place] = rng.integers(256)
    with suppress(InputError):
        read_masks(bytes(data[: rng.integers(200, len(data))]), "mask[0]", LIMITS)


def test_series_are_ordered_by_place(images):
    found = series_of(images[::-1])
    assert found.grid.coincides_with(grid_of(images))
    assert [i.SOPInstanceUID for i in found.images] == [i.SOPInstanceUID for i in images]
    with pytest.raises(InvalidGeometry, match="no regular stack"):
        series_of([*images, replace_position(images[-1])])
    with pytest.raises(InvalidGeometry, match="no images"):
        series_of([])


def replace_position(image):
    moved = reread(image)
    moved.ImagePositionPatient = [float(x) + 0.37 for x in image.ImagePositionPatient]
    return moved
