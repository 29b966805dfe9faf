"""Errors and interrupts as a sentence and an exit status; what is told before the work."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer

from model.errors import InvalidParameter
from model.geometry import Grid
from tests.ellipsoid_cohort import GRID, ellipsoids
from training import console, expectations
from training.cohorts import Case, Cohort, Provenance
from training.cohorts.inspect import extent_mm
from training.console import check_output, exit_status
from training.interruption import Stopped


def test_an_interrupt_says_how_the_training_goes_on(capsys):
    with pytest.raises(typer.Exit) as caught, exit_status(goes_on="--resume goes on"):
        raise Stopped(3, 9)
    assert caught.value.exit_code == 130
    assert capsys.readouterr().err == "morphoflow: stopped at step 3 of 9; --resume goes on\n"


def test_a_path_that_cannot_be_used_is_one_sentence(capsys, tmp_path):
    (tmp_path / "file").write_text("here")
    with pytest.raises(typer.Exit) as caught, exit_status():
        (tmp_path / "file" / "x").mkdir()
    assert caught.value.exit_code == 2
    words = capsys.readouterr().err
    assert "cannot be read or written: Not a directory" in words
    assert len(words.splitlines()) == 1


class TestProgress:
    def test_a_log_gets_a_line_now_and_then(self, capsys, monkeypatch):
        monkeypatch.setattr(console, "LINE_EVERY_S", 0.0)
        with console.progress(4, "fitting") as bar:
            bar.advance(bar.task_ids[0])
            bar.update(bar.task_ids[0], completed=3, total=5, description="measuring")
        assert capsys.readouterr().err == "fitting: 1 of 4\nmeasuring: 3 of 5\n"

    def test_short_work_writes_nothing_into_a_log(self, capsys):
        with console.progress(1, "fitting") as bar:
            bar.advance(bar.task_ids[0])
        assert capsys.readouterr().err == ""


class TestOutput:
    def test_what_is_not_there_yet_is_accepted(self, tmp_path):
        (tmp_path / "file.csv").write_text("old")
        check_output(tmp_path, is_folder=True)
        check_output(tmp_path / "new" / "run", is_folder=True)
        check_output(tmp_path / "new" / "page.html", is_folder=False)
        check_output(tmp_path / "file.csv", is_folder=False)
        check_output(Path("page.html"), is_folder=False)

    def test_what_is_in_the_way_is_told_of(self, tmp_path):
        (tmp_path / "file").write_text("here")
        for path, is_folder in (
            (tmp_path / "file" / "x", True),
            (tmp_path / "file", True),
            (tmp_path / "file" / "x.html", False),
            (tmp_path, False),
            (Path("/dev/null/x"), True),
        ):
            with pytest.raises(InvalidParameter, match="cannot be written"):
                check_output(path, is_folder=is_folder)


def cohort(train, validation):
    cases = tuple(Case(f"e{n}", f"e{n}", "train", shape.mask(GRID), GRID) for n, shape in enumerate(ellipsoids(1)))
    provenance = Provenance("made here", "CC0-1.0", "nobody", shippable=True)
    return Cohort("ellipsoids", train * cases, validation * cases, (), (), provenance)


class TestExpectations:
    @pytest.mark.parametrize(
        ("told", "few", "enough"),
        [
            (expectations.of_training, cohort(9, 0), cohort(10, 0)),
            (expectations.of_calibration, cohort(50, 3), cohort(5, 4)),
            (expectations.of_completion, cohort(49, 9), cohort(50, 0)),
        ],
    )
    def test_few_shapes_are_told_of(self, told, few, enough):
        assert "few" in told(few)
        assert told(enough) == ""

    def test_small_shapes_are_told_of(self):
        usual = cohort(10, 0)
        length = extent_mm(usual.train[0].mask, GRID)
        for aim, told in ((0.9 * expectations.SMALL_MM, True), (1.1 * expectations.SMALL_MM, False)):
            grid = Grid(GRID.shape, np.diag([aim / length] * 3 + [1.0]) @ GRID.affine)
            shapes = tuple(replace(case, grid=grid) for case in usual.train)
            assert ("spacing" in expectations.of_training(replace(usual, train=shapes))) is told

    def test_one_shape_makes_no_model(self):
        with pytest.raises(InvalidParameter, match="1 training shape"):
            expectations.of_training(cohort(1, 1))
        assert expectations.of_training(cohort(2, 1))
