"""What a sweep is made of and keeps: its plan, its table, its record, and the report's files."""

import csv
import json
import multiprocessing
from dataclasses import replace

import numpy as np
import pytest

from model.errors import InvalidParameter
from tests.sweep_parts import EFFORT, call, result
from training.cohorts import CohortOptions
from training.cohorts.sources import CohortSource, LayoutName
from training.report import FIGURES
from training.sweep.plan import Cell, by_training, cells_of
from training.sweep.priors import PriorName
from training.sweep.record import read_record, write_record
from training.sweep.summary import correlation, row_of, write_csv
from training.sweep.table import append, done, read_results
from training.sweep.workers import held


class TestPlan:
    def test_every_combination_stands_once(self):
        cells = cells_of([32, 16, 16], ["thin", "thick"], [PriorName.FLOW_ARD, PriorName.PLAIN], range(3), "paper")
        assert len(cells) == len({cell.key for cell in cells}) == 2 * 2 * 2 * 3
        assert [cell.latent_size for cell in cells] == 12 * [16] + 12 * [32]
        assert [cell.prior for cell in cells[:6]] == 3 * [PriorName.PLAIN] + 3 * [PriorName.FLOW_ARD]

    def test_dense_cells_are_measured_in_every_sparse_regime(self):
        assert Cell("dense", 8, PriorName.ARD).measured_in == ("thin", "thick", "orthogonal")
        assert Cell("thick", 8, PriorName.ARD).measured_in == ("thick",)

    @pytest.mark.parametrize("prior", PriorName)
    def test_priors_say_what_they_have(self, prior):
        assert (prior.flow, prior.ard) == ("flow" in prior.value, "ard" in prior.value)
        assert PriorName.of(flow=prior.flow, ard=prior.ard) is prior

    @pytest.mark.parametrize(("objective", "trainings"), [("variational", 2), ("paper", 8), ("centred", 8)])
    def test_cells_share_a_training_where_the_prior_is_fitted_afterwards(self, objective, trainings):
        cells = cells_of([16], ["thin", "thick"], PriorName, [0], objective)
        found = by_training(cells)
        assert len(found) == trainings
        assert [cell for group in found.values() for cell in group] == cells


class TestTable:
    def test_what_was_written_is_read(self, tmp_path):
        for key in "abc":
            append(tmp_path, result(key))
        assert read_results(tmp_path) == [result(key) for key in "abc"]
        assert done(tmp_path) == set("abc")

    def test_a_line_that_a_kill_cut_short_is_passed_over_and_the_next_one_stands_alone(self, tmp_path):
        append(tmp_path, result("a"))
        with (tmp_path / "results.jsonl").open("a") as stream:
            stream.write('{"key": "b", "regi')
        append(tmp_path, result("c"))
        assert done(tmp_path) == {"a", "c"}

    def test_processes_write_whole_lines(self, tmp_path):
        context = multiprocessing.get_context("fork")
        writers = [context.Process(target=append, args=(tmp_path, result(f"k{n}"))) for n in range(8)]
        for writer in writers:
            writer.start()
        for writer in writers:
            writer.join()
        assert done(tmp_path) == {f"k{n}" for n in range(8)}

    def test_rows_hold_means_over_what_was_measured(self, tmp_path):
        write_csv([result()], tmp_path / "table.csv")
        (row,) = csv.DictReader((tmp_path / "table.csv").read_text(encoding="utf-8").splitlines())
        assert (float(row["asd_mm_mean"]), row["cases"], row["failed"]) == (0.5, "1", "1")
        assert float(row["pearson_r"]) == pytest.approx(1.0)
        assert list(row) == list(row_of(None, ""))

    def test_no_spread_has_no_correlation(self):
        assert np.isnan(correlation(result(latent=[1.0, 1.0, 1.0])))

    def test_a_folder_without_a_table_is_refused(self, tmp_path):
        with pytest.raises(InvalidParameter, match="holds no results"):
            read_results(tmp_path)


class TestHolding:
    def test_a_cell_is_held_once_and_let_go(self, tmp_path):
        with held(tmp_path / "cell") as mine:
            assert mine
            with held(tmp_path / "cell") as other:
                assert not other
        with held(tmp_path / "cell") as again:
            assert again


class TestRecord:
    def test_source_and_options_come_back(self, tmp_path):
        source = CohortSource(masks=tmp_path, labels=(2, 3), layout=LayoutName.VERSE, align=True)
        options = CohortOptions(test_fraction=0.2, skip_refused=True)
        for _ in range(2):
            assert write_record(tmp_path / "s", source, replace(options, seed=5), EFFORT.settings())
            found = read_record(tmp_path / "s")
            assert found == (source, options)
            assert [type(value) for value in vars(found[0]).values()] == [
                type(value) for value in vars(source).values()
            ]
        assert [path.name for path in (tmp_path / "s").iterdir()] == ["sweep.json"]

    def test_a_sweep_of_other_shapes_is_refused(self, tmp_path):
        write_record(tmp_path / "s", CohortSource(masks=tmp_path), CohortOptions(), {})
        with pytest.raises(InvalidParameter, match="other shapes"):
            write_record(tmp_path / "s", CohortSource(masks=tmp_path / "more"), CohortOptions(), {})

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"steps": 9, "samples": 5}, "steps: 8 there, 9 asked"),
            ({"steps": None}, "steps: 8 there, 8000 asked"),
            ({"cases": 1}, "limit: all there, 1 asked"),
            ({"samples": 5}, "samples: 4 there, 5 asked"),
            ({"patience": 5}, "patience: 0 there, 5 asked"),
            ({"calibrate": True}, "calibrate: False there, True asked"),
        ],
    )
    def test_a_sweep_with_other_settings_is_refused_and_the_first_is_named(self, tmp_path, changes, words):
        source = CohortSource(masks=tmp_path)
        write_record(tmp_path / "s", source, CohortOptions(), EFFORT.settings())
        before = (tmp_path / "s" / "sweep.json").read_bytes()
        with pytest.raises(InvalidParameter, match=words):
            write_record(tmp_path / "s", source, CohortOptions(), replace(EFFORT, **changes).settings())
        assert (tmp_path / "s" / "sweep.json").read_bytes() == before

    def test_a_sweep_that_recorded_no_settings_is_read_and_goes_on_without_them(self, tmp_path):
        source, path = CohortSource(masks=tmp_path), tmp_path / "sweep.json"
        write_record(tmp_path, source, CohortOptions(), EFFORT.settings())
        values = json.loads(path.read_text(encoding="utf-8"))
        del values["settings"]
        values["source"]["data"] = "/of/public/cohorts"  # of the environment, and of no use
        path.write_text(json.dumps(values), encoding="utf-8")
        assert not write_record(tmp_path, source, CohortOptions(), replace(EFFORT, steps=9).settings())
        assert read_record(tmp_path) == (source, CohortOptions())
        assert json.loads(path.read_text(encoding="utf-8")) == values


class TestReport:
    """What is written, and what is not written over."""

    @pytest.fixture
    def folder(self, tmp_path):
        (tmp_path / "sweep").mkdir()
        append(tmp_path / "sweep", result(measured={"thin": {"one": dict.fromkeys(FIGURES, 0.5)}}))
        (tmp_path / "sweep" / "results.csv").write_text("the sweep's own")
        return tmp_path / "sweep"

    def report(self, folder, *words):
        return call("report", folder, "--no-pictures", "--output", *words)

    @pytest.mark.parametrize("name", ["page.csv", "page", "page.html.txt"])
    def test_other_files_than_html_are_refused(self, folder, tmp_path, name):
        answer = self.report(folder, tmp_path / name, "--force")
        assert answer.exit_code == 2
        assert "ends in .html or .htm" in answer.stderr
        assert not (tmp_path / name).exists()

    @pytest.mark.parametrize("name", ["results.html", "pages/page.htm"])
    def test_nothing_is_written_into_the_folder_of_a_sweep(self, folder, name):
        answer = self.report(folder, folder / name, "--force")
        assert answer.exit_code == 2
        assert "among the sweep's own" in answer.stderr
        assert (folder / "results.csv").read_text() == "the sweep's own"
        assert not (folder / name).exists()

    @pytest.mark.parametrize("name", ["page.HTM", "page.csv"])
    def test_files_that_are_there_are_overwritten_by_force_alone(self, folder, tmp_path, name):
        (tmp_path / name).write_text("mine")
        answer = self.report(folder, tmp_path / "page.HTM")
        assert answer.exit_code == 2
        assert f"{name} exists; another name, or --force" in answer.stderr
        assert (tmp_path / name).read_text() == "mine"
        assert self.report(folder, tmp_path / "page.HTM", "--force").exit_code == 0
        assert (tmp_path / name).read_text() != "mine"
