"""What a job does with a mask is what a single request does."""

import io

import pytest
from fastapi import UploadFile
from hypothesis import given
from hypothesis import strategies as st

from model.errors import InvalidParameter
from service.job_schemas import JobForm
from service.jobs.tools import options_of
from service.request_schemas import ReconstructionForm

FILE = UploadFile(io.BytesIO(b""))
CHOICES = st.fixed_dictionaries(
    {
        "annotated": st.sampled_from(["auto", "all", '[{"stack": 0, "axis": 2, "index": 7}]']),
        "uncertainty": st.sampled_from(["laplace", "ensemble", "none"]),
        "mirror": st.sampled_from(["auto", "never", "always"]),
        "resolution_mm": st.none() | st.floats(0.25, 10.0),
        "seed": st.integers(0, 1000),
        "fidelity": st.none() | st.floats(0.0, 1.0),
        "extents": st.sampled_from(["R, A", "longest", "1 0 0.5,S"]),
    }
)


@given(CHOICES)
def test_choices_of_a_job_are_those_of_a_request(choices):
    argument = JobForm(kind="reconstructions", archive=FILE, format="ply", **choices).argument()
    assert options_of(argument) == ReconstructionForm(mask=[FILE], **choices).options()


@given(CHOICES)
def test_a_request_that_becomes_a_job_keeps_its_choices(choices):
    form = ReconstructionForm(mask=[FILE], **choices)
    assert options_of(form.model_dump(exclude={"mask", "model"})) == form.options()


@pytest.mark.parametrize("name", ["fidelity", "mirror", "resolution_mm"])
def test_choices_of_reconstructions_are_refused_for_samples(name):
    value = {"fidelity": 0.5, "mirror": "auto", "resolution_mm": 1.0}[name]
    with pytest.raises(InvalidParameter, match=name):
        JobForm(kind="samples", **{name: value}).argument()


def test_blank_labels_are_none_as_other_blank_parts_are():
    assert JobForm(kind="samples", label=["", " "]).argument() == JobForm(kind="samples").argument()
    with pytest.raises(InvalidParameter, match="label"):
        JobForm(kind="samples", label=["", "1"]).argument()
