"""Images that are damaged, or made to cost much: read or refused, in bounded memory."""

import bz2
import gzip
import tracemalloc
import zlib

import nibabel as nib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.errors import InputError, UnreadableImage
from service.adapters.images import ImageLimits, read_mask
from service.adapters.nrrd_format import FIELD_LIMIT
from tests.bad_inputs import LIMITS, drawn, many_axes_mha, many_axes_nrrd, mha_text, nifti, nrrd_text
from tests.layered_segmentations import layered_segmentation

MEBIBYTE = 1 << 20
RAW = drawn().tobytes(order="F")
SOUND = {
    "nifti": nifti(drawn(), zipped=False),
    "nifti gzip": nifti(drawn()),
    "nifti 2": nib.Nifti2Image(drawn(), np.eye(4)).to_bytes(),
    "nrrd": nrrd_text("6 7 8"),
    "nrrd gzip": nrrd_text("6 7 8", encoding="gzip", data=gzip.compress(RAW)),
    "nrrd bzip2": nrrd_text("6 7 8", encoding="bzip2", data=bz2.compress(RAW)),
    "nrrd layers": layered_segmentation([drawn(), drawn()], [(0, 1), (1, 1)]),
    "metaimage": mha_text(),
    "metaimage zlib": mha_text(compressed="True", data=zlib.compress(RAW)),
}
TEXT_HEADERS = [name for name in SOUND if name.startswith(("nrrd", "metaimage"))]
WORDS = [
    *("nan", "inf", "-1", "0", "1e400", "1e-320", "none", "()", "(1,2", "x", "", "3", '"', "0x10", "1_0", "\xb2"),
    *("9" * 5000, "1 " * 300, "none " * 3000, f"({'1,' * 3000}1)", "4294967295", "-9223372036854775808", "LOCAL"),
]


def read_or_refused(content, labels=None):
    """A sound stack or none; never another error, and never much memory."""
    tracemalloc.start()
    try:
        stack = read_mask(content, "mask[0]", LIMITS, labels)
    except InputError:
        return
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 8 * LIMITS.max_voxels + 8 * MEBIBYTE
    assert stack.foreground.shape == stack.grid.shape
    assert np.isfinite(stack.grid.affine).all()


@given(st.sampled_from(sorted(SOUND)), st.sampled_from([None, frozenset({1})]), st.data())
def test_damage_anywhere_is_read_or_refused_and_never_crashes(name, labels, data):
    damaged = bytearray(SOUND[name])
    head = min(len(damaged), 400)
    for _ in range(data.draw(st.integers(1, 6))):
        damaged[data.draw(st.integers(0, head - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.sampled_from([len(damaged), len(damaged) // 2, head]))
    read_or_refused(bytes(damaged[:end]), labels)


@given(st.sampled_from(sorted(SOUND)), st.data())
def test_parts_that_are_repeated_or_left_out_are_read_or_refused(name, data):
    content = SOUND[name]
    first, last = sorted(data.draw(st.tuples(*[st.integers(0, len(content))] * 2)))
    read_or_refused(content[:first] + content[first:last] * data.draw(st.sampled_from([0, 2, 50])) + content[last:])


def lines_of(name):
    """The lines of a text header, its sign between name and value, and what follows it."""
    head, end, _ = SOUND[name].partition(b"\n\n" if "nrrd" in name else b"LOCAL\n")
    return (head + end).split(b"\n"), b":" if "nrrd" in name else b"=", SOUND[name][len(head + end) :]


@given(st.sampled_from(TEXT_HEADERS), st.data())
def test_any_value_of_a_text_header_is_read_or_refused(name, data):
    lines, sign, rest = lines_of(name)
    number = data.draw(st.integers(1, len(lines) - 1))
    value = " ".join(data.draw(st.lists(st.sampled_from(WORDS), max_size=4)))
    lines[number] = lines[number].split(sign)[0] + sign + b" " + value.encode("latin-1")
    read_or_refused(b"\n".join(lines) + rest)


@given(st.sampled_from(TEXT_HEADERS), st.data())
def test_lines_of_a_text_header_that_are_repeated_or_left_out_are_read_or_refused(name, data):
    lines, _, rest = lines_of(name)
    for _ in range(data.draw(st.integers(1, 4))):
        line = lines.pop(data.draw(st.integers(0, len(lines) - 1)))
        for _ in range(data.draw(st.integers(0, 2))):
            lines.insert(data.draw(st.integers(0, len(lines))), line)
    read_or_refused(b"\n".join(lines) + rest)


def with_field(text, content=b""):
    return (content or SOUND["nrrd"]).replace(b"encoding:", text.encode() + b"\nencoding:")


HOSTILE = {
    "20000 axes, MetaImage": lambda: many_axes_mha(20000),
    "20000 axes, NRRD": lambda: many_axes_nrrd(20000),
    "wide matrix": lambda: with_field(f"measurement frame: {'none ' * 4000}({'1,' * 8000}1)"),
    "wide directions": lambda: nrrd_text("6 7 8", f"{'none ' * 4000}({'1,' * 8000}1)"),
    "many fields": lambda: with_field("\n".join(f"a{n}: {n}" for n in range(20000))),
    "many segments": lambda: with_field("\n".join(f"Segment{n}_Layer:={n}" for n in range(20000))),
    "many fields, MetaImage": lambda: mha_text().replace(b"Offset", b"".join(b"a%d = 1\n" % n for n in range(20000))),
    "many members": lambda: gzip.compress(b"") * 40000,
    "long file name": lambda: b"\x1f\x8b\x08\x08\0\0\0\0\0\3" + b"a" * MEBIBYTE,
}


@pytest.mark.parametrize("name", HOSTILE)
def test_costly_headers_are_read_or_refused_in_little_memory(name):
    content = HOSTILE[name]()
    tracemalloc.start()
    try:
        read_mask(content, "mask[0]", LIMITS)
    except InputError:
        pass
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 16 * MEBIBYTE + 8 * len(content)


def test_a_picture_is_refused_in_memory_of_a_few_numbers_a_voxel():
    picture = np.arange(64**3, dtype=np.uint32).reshape(64, 64, 64)
    content = nifti(picture, zipped=False)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="distinct values, like a picture"):
            read_mask(content, "mask[0]", ImageLimits(max_bytes=2 * len(content), max_voxels=64**3))
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 24 * 64**3 + 8 * MEBIBYTE


@pytest.mark.parametrize(
    "text", ['labels: "i" "j" "k', "measurement frame: (1,0", "old min: x", "content: a: b", "Sizes:=7", "sizes:=7"]
)
def test_fields_of_nrrd_that_are_not_needed_may_hold_anything(text):
    np.testing.assert_array_equal(read_mask(with_field(text), "mask[0]", LIMITS).foreground, drawn() == 1)


def test_fields_of_nrrd_that_are_needed_have_a_longest_length():
    longest = "(1,0,0) (0,1,0)" + "(0,0,1)".rjust(FIELD_LIMIT - len("(1,0,0) (0,1,0)"))
    assert read_mask(nrrd_text("6 7 8", longest), "mask[0]", LIMITS).grid.shape == (6, 7, 8)
    with pytest.raises(UnreadableImage, match="field of over"):
        read_mask(nrrd_text("6 7 8", longest.replace(" ", "  ", 1)), "mask[0]", LIMITS)


@pytest.mark.parametrize("extra", [b"", b"\n\n"])
def test_an_nrrd_header_by_itself_is_told_that_its_voxels_are_elsewhere(extra):
    head = with_field("data file: mask.raw").partition(b"\n\n")[0]
    with pytest.raises(UnreadableImage, match="voxels in another file"):
        read_mask(head + extra, "mask[0]", LIMITS)
