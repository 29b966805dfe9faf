"""What commands say to the person who typed them."""

import pytest

from service.cli import BAD_INPUT, main
from service.model_registry import ModelRegistry
from tests.analytic_model import ellipsoid_model
from tests.service_parts import NAME, mask_bytes


def run(*words):
    return main([str(word) for word in words], lambda _settings: ModelRegistry({NAME: ellipsoid_model(NAME)}, []))


def test_a_mask_that_is_not_there_is_named_as_it_was_typed(tmp_path, capsys):
    there, missing = tmp_path / "there.nii", tmp_path / "nothere.nii.gz"
    there.write_bytes(mask_bytes())
    assert run("reconstruct", there, missing) == BAD_INPUT
    assert f"Each MASK must be a file; there is no file {missing}." in capsys.readouterr().err


@pytest.mark.parametrize(("count", "words"), [(1, f"1 shape of {NAME} written."), (2, f"2 shapes of {NAME} written.")])
def test_shapes_are_counted_in_words(tmp_path, capsys, count, words):
    assert run("sample", "--count", count, "--output", tmp_path / "shapes") == 0
    assert capsys.readouterr().out.strip() == words


def test_help_says_when_the_archive_of_a_job_is_written(capsys):
    assert run("jobs", "watch", "--help") == 0
    told = capsys.readouterr().out
    assert "once the job is done" in told
    assert "only begins it" not in told
