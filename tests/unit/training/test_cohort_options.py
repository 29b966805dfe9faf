"""Which cohort is meant, from the options of a command."""

from contextlib import contextmanager

import nibabel as nib
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from tests.ellipsoid_cohort import GRID, ellipsoids
from training import cohort_options
from training.cohort_options import DATA_VARIABLE, opened_cohort, takes_cohort
from training.cohorts import CohortOptions
from training.cohorts.cohort import SideName
from training.cohorts.sources import CohortSource, LayoutName
from training.cohorts.voxelising import SpaceName
from training.console import progress


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


def test_a_bar_shows_how_far_an_alignment_is(monkeypatch, tmp_path):
    for n, shape in enumerate(ellipsoids(3)):
        nib.save(nib.Nifti1Image(shape.mask(GRID).astype(np.uint8), GRID.affine), tmp_path / f"e{n}.nii.gz")
    bars = []

    @contextmanager
    def kept(total, words):
        with progress(total, words) as bar:
            bars.append(bar)
            yield bar

    monkeypatch.setattr(cohort_options, "progress", kept)
    opened_cohort(CohortSource(masks=tmp_path), CohortOptions())
    assert bars == []
    assert len(opened_cohort(CohortSource(masks=tmp_path, align=True), CohortOptions()).train) == 2
    (task,) = bars[0].tasks
    assert (task.completed, task.total) == (3 * 2 + 1, 3 * 2 + 1)
