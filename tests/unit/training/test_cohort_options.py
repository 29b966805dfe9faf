"""Which cohort is meant, from the options of a command."""

import nibabel as nib
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from tests.ellipsoid_cohort import GRID, ellipsoids
from training.cohort_options import opened_cohort, takes_cohort
from training.cohorts import CohortOptions
from training.cohorts.catalogue import DATA_VARIABLE
from training.cohorts.cohort import SideName
from training.cohorts.sources import CohortSource, LayoutName
from training.cohorts.voxelising import SpaceName


@pytest.fixture
def asked():
    """What a command gets for its words, and how it ends."""
    got = []
    app = typer.Typer()

    @app.command()
    @takes_cohort
    def look(source, options):
        got.append((source, options))

    def ask(*words, **environment):
        result = CliRunner().invoke(app, [str(word) for word in words], env=environment)
        return (got.pop() if got else None), result

    return ask


def test_options_that_are_left_out_have_their_defaults(asked, tmp_path):
    assert asked("--masks", tmp_path)[0] == (CohortSource(masks=tmp_path), CohortOptions())


def test_options_reach_the_source(asked, tmp_path):
    (source, _), _ = asked("--meshes", tmp_path, "--spacing-mm", 2, "--mesh-space", "LPS", "--side", "left", "--align")
    assert source == CohortSource(meshes=tmp_path, spacing_mm=2.0, space=SpaceName.LPS, side=SideName.LEFT, align=True)
    (source, _), _ = asked("--masks", tmp_path, "--layout", "verse", "--label", 20, "--label", 21)
    assert source == CohortSource(masks=tmp_path, layout=LayoutName.VERSE, labels=(20, 21))


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("--meshes", ".", "--layout", "folder"), "--layout"),
        (("--meshes", ".", "--label", 3), "--label"),
        (("--masks", ".", "--layout", "medmnist", "--label", 3), "--label"),
        (("--masks", ".", "--spacing-mm", 1), "--spacing-mm"),
        (("--masks", ".", "--mesh-space", "RAS"), "--mesh-space"),
        (("--masks", ".", "--data", "."), "--data"),
        (("--cohort", "talus", "--side", "mixed"), "--side"),
    ],
)
def test_an_option_that_would_do_nothing_is_refused_even_with_its_default(asked, words, option):
    got, result = asked(*words)
    assert got is None
    assert result.exit_code == 2
    assert f"{option} would do nothing here; {option} goes with" in result.stderr


def test_the_data_folder_of_the_environment_is_no_choice_of_the_caller(asked, tmp_path):
    environment = {DATA_VARIABLE: str(tmp_path)}
    (source, _), _ = asked("--masks", tmp_path, **environment)
    assert source.data is None
    (source, _), _ = asked("--cohort", "talus", **environment)
    assert source.data == tmp_path
    assert asked("--masks", tmp_path, "--data", ".", **environment)[0] is None


def test_a_bar_shows_how_far_an_alignment_is(monkeypatch, capsys, tmp_path):
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE"):  # a terminal, to those that ask
        monkeypatch.setenv(name, "1")
    monkeypatch.setenv("TERM", "xterm")
    for n, shape in enumerate(ellipsoids(3)):
        nib.save(nib.Nifti1Image(shape.mask(GRID).astype(np.uint8), GRID.affine), tmp_path / f"e{n}.nii.gz")
    opened_cohort(CohortSource(masks=tmp_path), CohortOptions())
    assert "aligning shapes" not in capsys.readouterr().err
    assert len(opened_cohort(CohortSource(masks=tmp_path, align=True), CohortOptions()).train) == 2
    shown = capsys.readouterr().err
    assert "aligning shapes" in shown
    whole = 3 * 2 + 1
    assert f"{whole}/{whole}" in shown
