"""Archives of masks: what is damaged in one is told, and none unpacks to more than it may."""

import io
import zipfile
from dataclasses import replace

import pytest

from model.errors import InvalidParameter, TooLarge
from service.job_archives import ArchiveLimits, left_out, masks_in, open_archive, zip_of_folder

LIMITS = ArchiveLimits(max_masks=10, max_mask_bytes=10_000, max_bytes=25_000)
MASKS = {"a.nii": b"a" * 5000, "b.nii": b"b" * 5000, "c.nii.gz": b"c"}
END, ENTRY = b"PK\x05\x06", b"PK\x01\x02"


def packed(members=MASKS, method=zipfile.ZIP_DEFLATED):
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return bytearray(target.getvalue())


def of_a_later_version():
    archive = packed()
    archive[archive.index(ENTRY) + 6] = 99
    return archive


def of_a_name_that_is_no_text():
    archive = packed({"\u00e9.nii": b"e"})
    place = archive.index("\u00e9".encode(), archive.index(ENTRY))
    archive[place : place + 2] = b"\xff\xfe"
    return archive


def with_a_damaged_stream():
    archive = packed()
    place = archive.index(b"b.nii") + len("b.nii")
    archive[place : place + 8] = b"\xff" * 8
    return archive


def with_a_wrong_checksum():
    archive = packed(method=zipfile.ZIP_STORED)
    archive[archive.index(b"bbbb")] = ord("x")
    return archive


def with_an_encrypted_member():
    archive = packed()
    archive[archive.index(ENTRY, archive.index(ENTRY) + 1) + 8] |= 1
    return archive


def with_an_unknown_method():
    archive = packed()
    archive[archive.index(ENTRY, archive.index(ENTRY) + 1) + 10] = 98
    return archive


@pytest.mark.parametrize(
    "archive",
    [b"", b"hello", packed()[:-30], of_a_later_version(), of_a_name_that_is_no_text()],
    ids=["nothing", "no ZIP", "its end is gone", "a later version", "a name that is no text"],
)
def test_what_is_no_whole_zip_is_refused(archive):
    with pytest.raises(InvalidParameter) as caught:
        open_archive(io.BytesIO(archive), LIMITS)
    assert caught.value.part == "archive"


@pytest.mark.parametrize(
    ("archive", "word"),
    [
        (with_a_damaged_stream(), "damaged"),
        (with_a_wrong_checksum(), "damaged"),
        (with_an_encrypted_member(), "encrypted"),
        (with_an_unknown_method(), "deflated"),
        (packed({**MASKS, "b.nii": bytes(10_001)}), "larger than 10000 bytes"),
        (packed(MASKS, zipfile.ZIP_BZIP2), "deflated"),
    ],
    ids=["stream", "checksum", "password", "method", "size", "bzip2"],
)
def test_a_member_at_fault_stops_no_other(archive, word):
    masks = {mask.name: mask for mask in masks_in(io.BytesIO(archive), LIMITS)}
    assert word in str(masks["b.nii"].problem)
    assert masks["b.nii"].content == b""
    if word != "deflated":
        assert (masks["a.nii"].content, masks["c.nii.gz"].content) == (MASKS["a.nii"], MASKS["c.nii.gz"])


def test_masks_come_in_the_order_of_their_names_and_nothing_else_does():
    members = {"z.nii": b"1", "m/a.nrrd": b"2", "m/.b.nii": b"", "__MACOSX/c.nii": b"", "read.me": b"", "m/": b""}
    assert [(mask.name, mask.content) for mask in masks_in(io.BytesIO(packed(members)), LIMITS)] == [
        ("m/a.nrrd", b"2"),
        ("z.nii", b"1"),
    ]


def test_masks_that_are_too_many_or_too_large_together_are_refused_before_one_is_unpacked():
    few = bytes(packed({f"{number}.nii": bytes(9000) for number in range(3)}))
    many = bytes(packed({f"{number}.nii": b"" for number in range(11)}))
    for archive, word in ((few, "25000 bytes together"), (many, "10 masks")):
        with pytest.raises(TooLarge, match=word):
            next(masks_in(io.BytesIO(archive), LIMITS))


def test_the_masks_of_a_folder_are_those_of_its_zip(tmp_path):
    (tmp_path / "deep").mkdir()
    for name in ("deep/b.nii", "a.nrrd", "read.me", ".c.nii"):
        (tmp_path / name).write_bytes(name.encode())
    target = io.BytesIO()
    zip_of_folder(tmp_path, target)
    found = [(mask.name, mask.content) for mask in masks_in(target, LIMITS)]
    assert found == [("a.nrrd", b"a.nrrd"), ("deep/b.nii", b"deep/b.nii")]


def test_a_list_of_members_that_no_job_needs_is_not_even_read():
    """Each of its entries would take ten times the room in memory."""
    archive = bytearray(packed({f"{number}.txt": b"" for number in range(25_000)}, zipfile.ZIP_STORED))
    with pytest.raises(TooLarge, match="list of members"):
        open_archive(io.BytesIO(archive), LIMITS)
    with open_archive(io.BytesIO(archive), replace(LIMITS, max_masks=10_000)) as opened:
        assert len(opened.namelist()) == 25_000


def test_files_that_are_no_masks_are_told_and_objects_without_a_suffix_are_masks():
    archive = io.BytesIO(packed({**MASKS, "study/IM0001": b"d", "notes.txt": b"n", ".hidden": b"h", "x.seg": b"s"}))
    assert [mask.name for mask in masks_in(archive, LIMITS)] == [*MASKS, "study/IM0001"]
    assert left_out(archive, LIMITS) == ["notes.txt", "x.seg"]
