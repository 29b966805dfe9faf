"""What a form at fault is told: files and texts that are mixed up, bodies beyond the reader's own limits, labels."""

import gzip
import io
import zipfile

import nibabel as nib
import numpy as np
import pytest

from tests.dicom_parts import file_bytes, mr_series, seg_of
from tests.service_parts import app_for, mask_parts, problem, running, sparse_ellipsoid

RECONSTRUCTIONS, JOBS = "/v1/reconstructions", "/v1/jobs"
ASYNC = {"Prefer": "respond-async"}


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    with running(app_for(tmp_path_factory.mktemp("forms"))) as client:
        yield client


@pytest.mark.parametrize(
    ("path", "parts", "part", "name"),
    [
        (RECONSTRUCTIONS, {"mask": (None, "ax.nii.gz")}, "mask[0]", "mask"),
        ("/v1/planes", {"mask": (None, "ax.nii.gz")}, "mask[0]", "mask"),
        (JOBS, {"kind": (None, "reconstructions"), "archive": (None, "a.zip")}, "archive", "archive"),
    ],
)
def test_a_text_in_place_of_a_file_is_told_how_to_send_one(client, path, parts, part, name):
    told = problem(client.post(path, files=parts), 422)
    assert (told["part"], f"-F {name}=@FILE" in told["detail"], "class" in told["detail"]) == (part, True, False)


@pytest.mark.parametrize("name", ["label", "seed", "annotated", "uncertainty"])
def test_a_file_in_place_of_a_text_is_told_how_to_send_one(client, name):
    told = problem(client.post(RECONSTRUCTIONS, files=[*mask_parts(b"1"), (name, ("l.txt", b"1"))]), 422)
    assert told["part"].startswith(name)
    assert f"-F {name}=VALUE" in told["detail"]


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ([("mask", ("m", b"1"))] * 1001, "At most 8 files are accepted"),
        ([("mask", ("m", b"1")), *[("label", (None, "1"))] * 1001], "64 parts that are no file"),
        ([("mask", ("m", b"1")), ("annotated", (None, "a" * (2**20 + 1)))], "1024 KiB"),
    ],
)
def test_bodies_beyond_the_readers_limits_are_too_large(client, parts, told):
    answer = problem(client.post(RECONSTRUCTIONS, files=parts), 413)
    assert answer["type"].endswith("too-large")
    assert told in answer["detail"]


def test_a_label_may_be_as_large_as_a_mask_holds(client):
    values, grid = sparse_ellipsoid()
    for label in (70_000, 2**31 - 1):
        mask = nib.Nifti1Image(values.astype(np.int32) * label, grid.affine, dtype=np.int32).to_bytes()
        form = {"label": str(label), "uncertainty": "none"}
        assert client.post(RECONSTRUCTIONS, files=mask_parts(mask), data=form).status_code == 201
        absent = {**form, "label": str(label - 1)}
        assert "label" in problem(client.post(RECONSTRUCTIONS, files=mask_parts(mask), data=absent), 422)["detail"]


PLANES = '[{"stack": 0, "axis": 2, "index": 4}, {"stack": 1, "axis": 2, "index": 8}]'


@pytest.mark.parametrize(("form", "part"), [({"label": "255"}, "label"), ({"annotated": PLANES}, "annotated[1]")])
def test_a_job_is_refused_at_once_in_the_words_of_the_answer(client, form, part):
    asked = {**form, "uncertainty": "none"}
    now = problem(client.post(RECONSTRUCTIONS, files=mask_parts(), data=asked), 422)
    later = problem(client.post(RECONSTRUCTIONS, files=mask_parts(), data=asked, headers=ASYNC), 422)
    many = {"kind": "reconstructions", **asked}
    archived = problem(client.post(JOBS, files={"archive": ("a.zip", archive("a.nii"))}, data=many), 422)
    assert {answer["part"] for answer in (now, later, archived)} == {part}
    assert now["detail"] == later["detail"] == archived["detail"]


def test_stacks_of_dicom_objects_are_counted_by_the_job(client):
    drawing = file_bytes(seg_of(mr_series(), sparse_ellipsoid()[0]))
    asked = {"annotated": PLANES}
    assert client.post(RECONSTRUCTIONS, files=mask_parts(drawing), data=asked, headers=ASYNC).status_code == 202
    many = {"kind": "reconstructions", **asked}
    assert client.post(JOBS, files={"archive": ("a.zip", archive("a.dcm"))}, data=many).status_code == 202


def archive(name):
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as opened:
        opened.writestr(name, b"1")
    return target.getvalue()


def body_of(before=b"", after_boundary=b"", name="m.nii"):
    head = f'Content-Disposition: form-data; name="mask"; filename="{name}"'.encode()
    return before + b"--b" + after_boundary + b"\r\n" + head + b"\r\n\r\n1\r\n--b--\r\n"


@pytest.mark.parametrize(
    "body",
    [body_of(b"preamble\r\n"), body_of(after_boundary=b"  "), body_of(name="n" * 20_000)],
    ids=["preamble", "padding", "long name"],
)
def test_a_body_that_cannot_be_parsed_is_told_what_it_must_be_like(client, body):
    sent = {"Content-Type": "multipart/form-data; boundary=b"}
    told = problem(client.post(RECONSTRUCTIONS, content=body, headers=sent), 400)
    assert told["type"].endswith("malformed-request")
    assert "missing" not in told["detail"]
    assert "begin with it" in told["detail"]


@pytest.mark.parametrize("path", [RECONSTRUCTIONS, JOBS, "/v1/planes"])
def test_a_compressed_body_is_told_which_header_is_at_fault(client, path):
    sent = {"Content-Type": "multipart/form-data; boundary=b", "Content-Encoding": "gzip"}
    told = problem(client.post(path, content=gzip.compress(body_of()), headers=sent), 415)
    assert "Content-Encoding" in told["detail"]
    plain = client.post("/v1/planes", content=body_of(), headers={**sent, "Content-Encoding": "identity"})
    assert problem(plain, 415)["part"] == "mask[0]"


def test_blank_parts_of_a_page_are_left_out(client):
    blank = {"kind": "samples", "label": "", "archive": "", "mirror": "", "count": "2"}
    assert client.post(JOBS, files={name: (None, value) for name, value in blank.items()}).status_code == 202
