"""Readers and writer of mask images, against nibabel's and SimpleITK's own."""

import gzip
import io
import tracemalloc

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from model.errors import InputError, InvalidMask, TooLarge, UnreadableImage
from model.geometry import Grid
from model.inference.observations import find_planes
from service.adapters.images import ImageLimits, image_format, read_mask, write_nifti
from tests.bad_inputs import LIMITS, SECRET, bad_inputs, drawn, mha_text, nifti, nrrd_text

MEBIBYTE = 1 << 20


def labels_of(fields):
    return frozenset({int(fields["label"])}) if "label" in fields else None


def read_and_find_planes(files, labels):
    stacks = [read_mask(data, f"mask[{number}]", LIMITS, labels) for number, data in enumerate(files)]
    return find_planes(stacks, "auto")


def some_affine(seed=0, spacing=(0.7, 1.3, 4.0), flip=False):
    turn = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    affine = np.eye(4)
    affine[:3, :3] = turn @ np.diag(spacing) @ np.diag([-1 if flip else 1, 1, 1])
    affine[:3, 3] = (12.5, -40.25, 1000.0)
    return affine


@pytest.mark.parametrize("bad", bad_inputs(), ids=lambda bad: bad.name)
def test_each_bad_input_meets_its_error(bad):
    with pytest.raises(InputError) as caught:
        read_and_find_planes(bad.files(), labels_of(bad.fields))
    assert type(caught.value) is bad.error
    message = str(caught.value)
    assert caught.value.part.startswith(("mask", "label"))
    assert SECRET not in message
    assert "/" not in message
    assert "\n" not in message


@pytest.mark.parametrize("bad", [b for b in bad_inputs() if b.error is TooLarge], ids=lambda bad: bad.name)
def test_too_large_is_decided_in_little_memory(bad):
    files = bad.files()
    tracemalloc.start()
    try:
        with pytest.raises(TooLarge):
            read_mask(files[0], "mask[0]", LIMITS)
        assert tracemalloc.get_traced_memory()[1] < 8 * MEBIBYTE
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("kind", "label", "bytes_a_voxel"), [("u1", 1, 5), ("f8", 1, 5), ("f8", 300, 7)])
def test_memory_grows_with_the_voxels_and_not_with_their_type(kind, label, bytes_a_voxel):
    values = np.zeros((160, 160, 160), kind)
    values[40:60, 40:60, ::20] = label
    data = nifti(values)
    tracemalloc.start()
    try:
        stack = read_mask(data, "mask[0]", ImageLimits(values.nbytes, values.size))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(stack.foreground, values > 0)
    assert peak < bytes_a_voxel * values.size + 8 * MEBIBYTE


@pytest.mark.parametrize("label", [254, 300, 70_000, 2**31 - 1, 2**33])
def test_labels_of_any_size_are_told_apart(label):
    values = np.where(drawn() == 1, float(label), 0.0)
    values[0, 0, 0] = 2
    stack = read_mask(nifti(values), "mask[0]", LIMITS, frozenset({label}))
    np.testing.assert_array_equal(stack.foreground, drawn() == 1)


def test_labels_that_take_more_room_than_the_limit_are_too_large():
    values = np.where(drawn() == 1, 2.0**33, 0.0)
    with pytest.raises(TooLarge, match="bits"):
        read_mask(nifti(values), "mask[0]", ImageLimits(10**6, values.size))


def test_values_beyond_all_labels_are_refused():
    with pytest.raises(InvalidMask, match="label"):
        read_mask(nifti(drawn() * 1e300), "mask[0]", LIMITS)


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.int32, np.float32, np.float64])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("version", [nib.Nifti1Image, nib.Nifti2Image])
def test_nifti_is_read_as_nibabel_reads_it(kind, order, version):
    values = drawn().astype(np.dtype(kind).newbyteorder(order))
    header = version.header_class(endianness=order)
    image = version(values, some_affine(), header)
    stack = read_mask(image.to_bytes(), "mask[0]", LIMITS)
    np.testing.assert_array_equal(stack.foreground, drawn() == 1)
    np.testing.assert_allclose(stack.grid.affine, version.from_bytes(image.to_bytes()).affine, atol=1e-12)


@pytest.mark.parametrize(("sform", "qform"), [(1, 1), (1, 0), (0, 1), (0, 0)])
@pytest.mark.parametrize("flip", [False, True])
def test_sform_goes_before_qform_before_spacing(sform, qform, flip):
    image = nib.Nifti1Image(drawn(), np.eye(4))
    image.set_sform(some_affine(1, flip=flip), code=sform)
    image.set_qform(some_affine(2, flip=flip), code=qform)
    image.header["sform_code"], image.header["qform_code"] = sform, qform
    read = read_mask(image.to_bytes(), "mask[0]", LIMITS).grid.affine
    if sform:
        np.testing.assert_allclose(read, some_affine(1, flip=flip), atol=1e-4)
    elif qform:
        np.testing.assert_allclose(read, some_affine(2, flip=flip), atol=1e-3)
    else:
        np.testing.assert_allclose(read[:3, :3], np.diag([-0.7, 1.3, 4.0]), atol=1e-6)


@pytest.mark.parametrize(("unit", "factor"), [("meter", 1e3), ("mm", 1.0), ("micron", 1e-3), ("unknown", 1.0)])
def test_units_become_mm(unit, factor):
    image = nib.Nifti1Image(drawn(), np.diag([0.5, 0.5, 0.25, 1.0]))
    image.header.set_xyzt_units(xyz=unit)
    spacing = read_mask(image.to_bytes(), "mask[0]", LIMITS).grid.spacing
    np.testing.assert_allclose(spacing, np.array([0.5, 0.5, 0.25]) * factor)


def test_scaled_values_are_labels_after_scaling():
    image = nib.Nifti1Image(drawn(), np.eye(4))
    data = bytearray(image.to_bytes())
    header = nib.Nifti1Header(bytes(data[:348]))
    header["scl_slope"], header["scl_inter"] = 2.0, 0.0
    data[:348] = header.binaryblock
    stack = read_mask(bytes(data), "mask[0]", LIMITS, frozenset({2}))
    np.testing.assert_array_equal(stack.foreground, drawn() == 1)


def test_header_extensions_are_skipped():
    image = nib.Nifti1Image(drawn(), np.eye(4))
    image.header.extensions.append(nib.nifti1.Nifti1Extension("comment", b"x" * 1000))
    np.testing.assert_array_equal(read_mask(image.to_bytes(), "mask[0]", LIMITS).foreground, drawn() == 1)


def test_trailing_axes_of_length_one_are_dropped():
    image = nib.Nifti1Image(drawn()[..., None, None], np.eye(4))
    assert read_mask(image.to_bytes(), "mask[0]", LIMITS).grid.shape == (6, 7, 8)


def test_bytes_path_and_open_file_are_the_same(tmp_path):
    data = nifti(drawn(), some_affine())
    path = tmp_path / "anything.dat"
    path.write_bytes(data)
    stacks = [read_mask(source, "mask[0]", LIMITS) for source in (data, path, io.BytesIO(data))]
    for stack in stacks:
        np.testing.assert_array_equal(stack.foreground, stacks[0].foreground)
        np.testing.assert_array_equal(stack.grid.affine, stacks[0].grid.affine)


def through_itk(tmp_path, name, *, compressed, kind=np.uint8, seed=0):
    """A file by SimpleITK and the affine (RAS) that it stands for."""
    affine = some_affine(seed)
    lps = np.diag([-1, -1, 1, 1]) @ affine
    spacing = np.linalg.norm(lps[:3, :3], axis=0)
    image = sitk.GetImageFromArray(np.transpose(drawn().astype(kind), (2, 1, 0)).copy())
    image.SetSpacing(spacing.tolist())
    image.SetDirection((lps[:3, :3] / spacing).ravel().tolist())
    image.SetOrigin(lps[:3, 3].tolist())
    sitk.WriteImage(image, str(tmp_path / name), useCompression=compressed)
    return (tmp_path / name).read_bytes(), affine


@pytest.mark.parametrize("name", ["mask.nrrd", "mask.seg.nrrd", "mask.mha", "mask.nii", "mask.nii.gz"])
@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.uint32, np.int64, np.float32])
def test_all_formats_of_itk_give_the_same_voxels_in_the_same_world(tmp_path, name, compressed, kind):
    data, affine = through_itk(tmp_path, name, compressed=compressed, kind=kind)
    stack = read_mask(data, "mask[0]", LIMITS)
    np.testing.assert_array_equal(stack.foreground, drawn() == 1)
    np.testing.assert_allclose(stack.grid.affine, affine, atol=2e-4)
    assert stack.notes == ()


def plain_nifti():
    """A NIfTI that declares spacings alone."""
    return nib.Nifti1Image(drawn(), None).to_bytes()


@pytest.mark.parametrize(
    ("data", "axes"),
    [
        (plain_nifti(), "left, anterior and superior"),
        (nrrd_text("6 7 8").replace(b"space: left-posterior-superior\n", b""), "left, posterior and superior"),
        (
            nrrd_text("6 7 8", "(0,1,0) (1,0,0) (0,0,1)").replace(
                b"space: left-posterior-superior", b"space dimension: 3"
            ),
            "posterior, left and superior",
        ),
        (mha_text().replace(b"TransformMatrix = 1 0 0 0 1 0 0 0 1\n", b""), "left, posterior and superior"),
    ],
)
def test_an_orientation_that_no_file_declares_is_noted(data, axes):
    (note,) = read_mask(data, "mask[3]", LIMITS).notes
    assert note.startswith("mask[3] declares no orientation")
    assert axes in note


@pytest.mark.parametrize("data", [nifti(drawn()), nrrd_text("6 7 8"), mha_text()])
def test_a_declared_orientation_needs_no_note(data):
    assert read_mask(data, "mask[0]", LIMITS).notes == ()


@pytest.mark.parametrize(
    ("space", "signs"),
    [
        ("right-anterior-superior", (1, 1, 1)),
        ("RAS", (1, 1, 1)),
        ("left-posterior-superior", (-1, -1, 1)),
        ("LAS", (-1, 1, 1)),
    ],
)
def test_declared_space_of_nrrd_becomes_ras(space, signs):
    directions = "(0,2,0) (1,0,0) (0,0,3)"
    stack = read_mask(nrrd_text("6 7 8", directions, space=space), "mask[0]", LIMITS)
    expected = np.diag(signs) @ np.array([[0, 1, 0], [2, 0, 0], [0, 0, 3.0]])
    np.testing.assert_allclose(stack.grid.affine[:3, :3], expected)


@pytest.mark.parametrize(
    ("data", "found"),
    [(nifti(drawn()), "nifti"), (nrrd_text("6 7 8"), "nrrd"), (mha_text(), "metaimage"), (b"PK\3\4" * 200, None)],
)
def test_formats_are_told_apart_by_content(data, found):
    assert image_format(io.BytesIO(data)) == found


def test_a_limit_is_inclusive():
    data = nifti(drawn())
    exact = ImageLimits(max_bytes=len(data), max_voxels=drawn().size)
    assert read_mask(data, "mask[0]", exact).foreground.any()
    for limits in (ImageLimits(len(data) - 1, drawn().size), ImageLimits(len(data), drawn().size - 1)):
        with pytest.raises(TooLarge):
            read_mask(data, "mask[0]", limits)


@given(st.integers(0, 1000), st.booleans(), st.sampled_from([bool, np.uint8, np.float32]))
def test_written_nifti_reads_back(seed, flip, kind):
    rng = np.random.default_rng(seed)
    values = (rng.random((5, 6, 7)) * 3).astype(kind)
    grid = Grid((5, 6, 7), some_affine(seed, flip=flip))
    data = write_nifti(values, grid, "MorphoFlow")
    image = nib.Nifti1Image.from_bytes(gzip.decompress(data))
    np.testing.assert_array_equal(np.asanyarray(image.dataobj), values.astype(np.uint8) if kind is bool else values)
    assert image.get_data_dtype() == (np.float32 if kind is np.float32 else np.uint8)
    assert image.header.get_xyzt_units()[0] == "mm"
    # A qform holds three quaternion components in single precision: near half turns the fourth keeps half the digits.
    for (affine, code), tolerance in ((image.get_sform(coded=True), 1e-4), (image.get_qform(coded=True), 1e-2)):
        assert code == 1
        np.testing.assert_allclose(affine, grid.affine, atol=tolerance)


def test_written_nifti_is_repeatable_and_has_its_description():
    grid = Grid((6, 7, 8), some_affine())
    once = write_nifti(drawn(), grid, "probability, model α " + "x" * 200)
    assert once == write_nifti(drawn(), grid, "probability, model α " + "x" * 200)
    description = bytes(nib.Nifti1Image.from_bytes(gzip.decompress(once)).header["descrip"])
    assert description.startswith(b"probability, model  x")


def test_real_masks_read_as_nibabel_reads_them(shared_data):
    limits = ImageLimits(1 << 26, 1 << 25)
    for path in sorted(shared_data.glob("*/test/*.nii.gz"))[::8]:
        image = nib.load(path)
        stack = read_mask(path, "mask[0]", limits)
        np.testing.assert_array_equal(stack.foreground, np.asanyarray(image.dataobj) != 0)
        np.testing.assert_allclose(stack.grid.affine, image.affine, atol=1e-9)


@pytest.mark.parametrize("skip", [b"byte skip: -1", b"line skip: 2", b"byteskip: 12"])
def test_skips_of_nrrd_are_named_for_what_they_are(skip):
    data = nrrd_text("6 7 8").replace(b"space origin:", skip + b"\nspace origin:")
    with pytest.raises(UnreadableImage, match=r"mask\[0\] skips bytes or lines"):
        read_mask(data, "mask[0]", LIMITS)


@pytest.mark.parametrize("origin", [b"(1,2)", b"(1,2,3,4)"])
def test_a_malformed_origin_of_nrrd_is_named(origin):
    data = nrrd_text("6 7 8").replace(b"space origin: (0,0,0)", b"space origin: " + origin)
    with pytest.raises(InputError, match=r"mask\[0\] has a malformed space origin"):
        read_mask(data, "mask[0]", LIMITS)
