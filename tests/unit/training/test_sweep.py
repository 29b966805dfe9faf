import csv
import json
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace

import nibabel as nib
import numpy as np
import pytest
import torch
import typer
from typer.testing import CliRunner

from model.bundle import read_manifest, write_manifest
from model.errors import InvalidParameter
from training.calibration import calibrate_bundle_as
from training.choices import DeviceName
from training.cli import register
from training.cohorts import CohortOptions
from training.cohorts.sources import CohortSource, LayoutName, open_cohort
from training.prior_choice import chosen_parts
from training.pruning import PriorParts
from training.report import FIGURES
from training.reporting.chapters import pictured_seed
from training.sweep.cell import Effort, Place, adopt
from training.sweep.plan import Cell, by_training, cells_of
from training.sweep.priors import PriorName
from training.sweep.record import read_record, write_record
from training.sweep.streams import Progress, train_side_by_side
from training.sweep.summary import correlation, row_of, write_csv
from training.sweep.table import Result, append, done, read_results
from training.sweep.workers import Sweep, held, refusals, work, work_together

EFFORT = Effort(steps=8, calibrate=False, samples=4)
QUICK = [
    "--latent-size",
    "3",
    "--steps",
    "8",
    "--samples",
    "4",
    "--no-calibrate",
    "--device",
    "cpu",
    "--regime",
    "thin",
]


def result(key="a", **more):
    measured = {"thin": {"one": {"dice": 0.9, "asd_mm": 0.5, "hd95_mm": 2.0, "hd_mm": 4.0}, "two": None}}
    values = Result(
        key, "thin", 4, "flow-ard", 0, "variational", "vertebra", "made here", "CC0", True, 5, 8, 1.5, [1.0, 0.5],
        [1, 2, 2], [1.0, 2.0, 3.0], [0.1, 0.2, 0.3], measured,
    )  # fmt: skip
    return replace(values, **more)


def ellipsoid(n):
    index = np.stack(np.meshgrid(*[np.arange(28)] * 3, indexing="ij"), axis=-1)
    return (((index - 13.5) / [8.0 + 0.4 * n, 9.0, 10.0 - 0.3 * n]) ** 2).sum(axis=-1) <= 1.0


@pytest.fixture(scope="module")
def masks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("masks")
    for n in range(8):
        split = folder / ("test" if n > 5 else "train")
        split.mkdir(exist_ok=True)
        nib.save(nib.Nifti1Image(ellipsoid(n).astype(np.uint8), np.eye(4)), split / f"e{n}.nii.gz")
    return folder


def call(*words):
    app = typer.Typer()
    register(app)
    return CliRunner().invoke(app, [str(word) for word in words])


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


@pytest.fixture(scope="module")
def swept(masks, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep") / "out"
    words = ("sweep", "--masks", masks, *QUICK, "--output", folder, "--jobs", 1, "--json")
    return folder, words, call(*words)


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


class TestSweep:
    def test_the_table_has_a_line_for_each_cell(self, swept):
        folder, _, answer = swept
        assert answer.exit_code == 0, answer.output
        assert json.loads(answer.stdout.splitlines()[-1])["unfinished"] == 0
        results = {one.prior: one for one in read_results(folder)}
        assert set(results) == {"plain", "flow-ard"}
        for one in results.values():
            assert list(one.measured["thin"]) == ["e6", "e7"]
            bundle = read_manifest(folder / "cells" / one.key / "bundle")[0]
            assert one.sigmas == sorted(bundle.sigmas, reverse=True)
        assert len(set(results["plain"].sigmas)) == 1 < len(set(results["flow-ard"].sigmas))
        assert len((folder / "results.csv").read_text().splitlines()) == 3

    def test_what_is_there_is_skipped(self, swept):
        folder, words, _ = swept
        before = (folder / "results.jsonl").read_bytes()
        assert call(*words).exit_code == 0
        assert (folder / "results.jsonl").read_bytes() == before

    def test_other_settings_are_refused_and_named(self, swept):
        folder, words, _ = swept
        before = (folder / "results.jsonl").read_bytes()
        for more, difference in (
            (("--steps", 9), "steps: 8 there, 9 asked"),
            (("--limit", 1), "limit: all there, 1 asked"),
            (("--patience", 0), "patience: 5 there, 0 asked"),
        ):
            answer = call(*words, *more)
            assert answer.exit_code == 2
            assert f"other settings ({difference})" in answer.stderr
        assert (folder / "results.jsonl").read_bytes() == before

    @pytest.mark.parametrize("samples", [3, 0])
    def test_an_exported_model_is_a_cell_of_its_own(self, swept, masks, tmp_path, samples):
        """The row tells how many shapes the model was trained on, of however many the cohort has now."""
        folder, _, _ = swept
        (bundle,) = (folder / "cells").glob("*-flow-ard-*/bundle")
        more = shutil.copytree(masks, tmp_path / "more")
        nib.save(nib.Nifti1Image(ellipsoid(8).astype(np.uint8), np.eye(4)), more / "train" / "e8.nii.gz")
        words = ("sweep", "--masks", more, "--bundle", bundle, "--samples", samples, "--limit", 1, "--jobs", 1)
        answer = call(*words, "--output", tmp_path / "out")
        assert answer.exit_code == 0, answer.output
        (one,) = read_results(tmp_path / "out")
        assert (one.prior, one.regime, len(one.measured["thin"])) == ("flow-ard", "thin", 1)
        assert len(one.latent) <= samples
        assert (one.shapes, len(open_cohort(CohortSource(masks=more), CohortOptions()).train)) == (5, 6)

    def test_an_exported_model_is_not_measured_on_shapes_of_its_training(self, swept, masks, tmp_path):
        folder, _, _ = swept
        (bundle,) = (folder / "cells").glob("*-flow-ard-*/bundle")
        trained = open_cohort(CohortSource(masks=masks), CohortOptions()).train[0].name
        other = shutil.copytree(masks, tmp_path / "other")
        (other / "train" / f"{trained}.nii.gz").rename(other / "test" / f"a-{trained}.nii.gz")
        words = ("sweep", "--masks", other, "--bundle", bundle, "--samples", 0, "--limit", 1, "--jobs", 1)
        answer = call(*words, "--output", tmp_path / "out")
        assert answer.exit_code == 2
        assert f"trained on a-{trained}, which is to be among the test cases" in answer.stderr
        assert not (tmp_path / "out" / "results.jsonl").exists()

    def test_two_models_of_one_cell_are_refused(self, swept, masks, tmp_path):
        folder, _, _ = swept
        (bundle,) = (folder / "cells").glob("*-flow-ard-*/bundle")
        other = shutil.copytree(bundle, tmp_path / "other")
        words = ("sweep", "--masks", masks, "--bundle", bundle, "--bundle", other, "--output", tmp_path / "out")
        answer = call(*words)
        assert answer.exit_code == 2
        assert f"Two bundles belong to the cell {bundle.parent.name}" in answer.stderr
        assert not (tmp_path / "out").exists()

    def test_another_model_than_the_one_of_the_cell_is_refused(self, swept, masks, tmp_path):
        folder, _, _ = swept
        (bundle,) = (folder / "cells").glob("*-flow-ard-*/bundle")
        other = shutil.copytree(bundle, tmp_path / "other")
        write_manifest(replace(read_manifest(bundle)[0], likelihood_precision=0.37), other)
        place = Place(tmp_path / "run", tmp_path / "out" / "cells" / bundle.parent.name / "bundle", bundle)
        for _ in range(2):
            adopt(bundle, place)
        assert [path.name for path in place.bundle.parent.iterdir()] == ["bundle"]
        answer = call("sweep", "--masks", masks, "--bundle", other, "--output", tmp_path / "out")
        assert answer.exit_code == 2
        assert f"another bundle as the cell {bundle.parent.name}" in answer.stderr
        assert read_manifest(place.bundle)[0] == read_manifest(bundle)[0]

    def test_plain_cells_keep_their_prior_and_the_others_are_pruned(self, swept):
        folder, _, _ = swept
        pruned = {
            one.prior: "pruned" in read_manifest(folder / "cells" / one.key / "bundle")[0].training
            for one in read_results(folder)
        }
        assert pruned == {"plain": False, "flow-ard": True}
        assert len(list((folder / "trainings").glob("*/run/checkpoint.pt"))) == 1

    def test_a_prior_is_chosen_at_the_precision_that_the_cell_is_measured_with(self, swept, masks):
        folder, _, _ = swept
        (run,) = (folder / "trainings").glob("*/run")
        (fitted,) = (folder / "cells").glob("*-flow-ard-*/bundle")
        cases = open_cohort(CohortSource(masks=masks), CohortOptions()).validation
        measured = []
        choice = chosen_parts(run, PriorParts(), cases, ("thin",), (0.1,), lambda: measured.append(1))
        assert len(measured) <= 3
        manifest = read_manifest(fitted)[0]
        assert manifest.likelihood_precision == 0.1
        assert manifest.training["pruned"]["fitted"] == asdict(choice.parts)

    def test_other_priors_use_the_training_that_is_there_and_trust_drawings_as_its_plain_cell(self, swept, tmp_path):
        folder, words, _ = swept
        again = shutil.copytree(folder, tmp_path / "again")
        for path in (again / "sweep.json", again / "results.jsonl", *again.glob("cells/*-flow-ard-*/bundle")):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        append(again, *[one for one in read_results(folder) if one.prior == "plain"])
        (plain,) = again.glob("cells/*-plain-*/bundle")
        known = {"spread_mm": 0.77, "fidelity": 0.42}
        facts = {"cohort": "made here"}
        changed = replace(read_manifest(plain)[0], likelihood_precision=0.37, discrepancy=known, calibration=facts)
        write_manifest(changed, plain)
        (checkpoint,) = again.glob("trainings/*/run/checkpoint.pt")
        before = checkpoint.stat().st_mtime_ns
        calibrated = [word for word in words[:-4] if word != "--no-calibrate"]
        answer = call(*calibrated, again, "--prior", "plain", "--prior", "flow", "--prior", "ard", "--jobs", 1)
        assert answer.exit_code == 0, answer.output
        assert checkpoint.stat().st_mtime_ns == before
        assert [one.prior for one in read_results(again)] == ["plain", "flow", "ard"]
        for prior in ("flow", "ard"):
            (bundle,) = again.glob(f"cells/*-{prior}-*/bundle")
            found = read_manifest(bundle)[0]
            assert (found.training["pruned"]["fitted"]["flow"], found.training["pruned"]["fitted"]["ard"]) == (
                prior == "flow",
                prior == "ard",
            )
            assert (found.likelihood_precision, found.discrepancy) == (0.37, known)
            assert found.calibration == {**facts, "sound_drawings": 5, "sound_cases": 1}
            assert found.usual

    def test_trust_taken_over_takes_out_what_was_measured_before(self, swept, masks, tmp_path):
        folder, _, _ = swept
        (bundle,) = (folder / "cells").glob("*-flow-ard-*/bundle")
        other = shutil.copytree(bundle, tmp_path / "other")
        manifest = read_manifest(bundle)[0]
        write_manifest(replace(manifest, accuracy={"test/thin": {"dice": 0.9}}), other)
        known = replace(manifest, likelihood_precision=0.37, discrepancy={"spread_mm": 0.77, "fidelity": 0.42})
        calibrate_bundle_as(other, known, open_cohort(CohortSource(masks=masks), CohortOptions()))
        found = read_manifest(other)[0]
        assert (found.likelihood_precision, found.discrepancy) == (0.37, known.discrepancy)
        assert found.accuracy == {}

    def test_the_report_is_one_file_with_tables_and_panels(self, swept, tmp_path):
        folder, _, _ = swept
        answer = call("report", folder, "--output", tmp_path / "page.html", "--command", "made <here>")
        assert answer.exit_code == 0, answer.output
        text = (tmp_path / "page.html").read_text(encoding="utf-8")
        assert all(f"<h3>{letter}. " in text for letter in "ABCDE")
        assert "made &lt;here&gt;" in text
        assert text.count("data:image/png;base64,") >= 4
        assert not any(word in text for word in ("http://", "https://", 'src="/', "<script", "<link"))
        assert (tmp_path / "page.csv").read_text().count("\n") == 2

    def test_pictures_of_shapes_can_be_withheld(self, swept, tmp_path):
        folder, _, _ = swept
        assert call("report", folder, "--output", tmp_path / "page.html", "--published-only").exit_code == 0
        text = (tmp_path / "page.html").read_text(encoding="utf-8")
        assert text.count("not to be passed on") == 3

    def test_panels_show_the_test_shapes_of_the_seed_of_their_cells(self, swept, masks, tmp_path):
        """Without a test split the seed says which shapes are held out."""
        folder, _, _ = swept
        source, options = CohortSource(masks=masks / "train"), CohortOptions(test_fraction=0.4)
        held = {at: [one.name for one in open_cohort(source, replace(options, seed=at)).test] for at in range(9)}
        seed = next(at for at, names in held.items() if set(names).isdisjoint(held[0]))
        write_record(tmp_path / "sweep", source, options, EFFORT.settings())
        for one, at in ((one, at) for one in read_results(folder) for at in (seed, seed + 1)):
            key = f"{one.key.rpartition('-')[0]}-s{at}"
            measured = (
                {name: dict.fromkeys(FIGURES, 0.1 * n) for n, name in enumerate(held[seed])} if at == seed else {}
            )
            append(tmp_path / "sweep", replace(one, key=key, seed=at, measured={"thin": measured}))
            shutil.copytree(folder / "cells" / one.key, tmp_path / "sweep" / "cells" / key)
        assert pictured_seed(read_results(tmp_path / "sweep")) == seed
        answer = call("report", tmp_path / "sweep", "--output", tmp_path / "page.html")
        assert answer.exit_code == 0, answer.output
        text = (tmp_path / "page.html").read_text(encoding="utf-8")
        assert "not there any more" not in text
        assert all(re.search(rf"<h3>{letter}\. [^<]*</h3><figure>", text) for letter in "AD")

    def test_a_cohort_without_test_shapes_is_refused(self, masks, tmp_path):
        answer = call("sweep", "--masks", masks / "train", *QUICK, "--output", tmp_path / "out")
        assert answer.exit_code == 2
        assert "--test-fraction" in answer.stderr

    def test_patience_without_validation_shapes_is_refused_where_it_is_asked_for(self, masks, tmp_path):
        """All shapes are one person's, of whom none can be held out."""
        other = shutil.copytree(masks, tmp_path / "masks")
        lines = [f"e{n},one,train" for n in range(6)] + [f"e{n},other,test" for n in (6, 7)]
        (other / "cases.csv").write_text("\n".join(["case,person,split", *lines]))
        assert not open_cohort(CohortSource(masks=other), CohortOptions()).validation
        words = ("sweep", "--masks", other, *QUICK, "--output", tmp_path / "out", "--patience", 1)
        answer = call(*words)
        assert answer.exit_code == 2
        assert "no validation cases by which a training could end early" in answer.stderr
        assert not (tmp_path / "out").exists()


def test_a_killed_sweep_goes_on_from_its_checkpoint(masks, tmp_path, repository):
    folder = tmp_path / "out"
    words = ["sweep", "--masks", str(masks), *QUICK, "--steps", "1200", "--prior", "plain", "--output", str(folder)]
    program = "import typer; from training.cli import register; app = typer.Typer(); register(app); app()"
    environment = {**os.environ, "PYTHONPATH": str(repository)}

    def start():
        return subprocess.Popen(
            [sys.executable, "-c", program, *words, "--jobs", "1"],
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip

    first = start()
    while not list(folder.glob("trainings/*/run/checkpoint.pt")) and first.poll() is None:
        time.sleep(0.05)
    os.killpg(first.pid, signal.SIGKILL)
    first.communicate()
    checkpoint = next(folder.glob("trainings/*/run/checkpoint.pt"))
    reached = torch.load(checkpoint, weights_only=True)["step"]
    assert 0 < reached <= 1200
    events = len(list(folder.glob("trainings/*/run/figures/*")))
    output, _ = (second := start()).communicate()
    assert second.returncode == 0, output
    (one,) = read_results(folder)
    assert one.steps == 1200
    assert len(list(folder.glob("trainings/*/run/figures/*"))) >= events


def test_a_process_of_torchrun_waits_for_the_others(masks, tmp_path, repository):
    """torchrun ends all of its processes with the first that fails, and one with nothing left to do must not."""
    folder = tmp_path / "out"
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    words = ["sweep", "--masks", str(masks), *QUICK, "--latent-size", "4", "--prior", "plain", "--output", str(folder)]
    answer = subprocess.run(
        [*torchrun, "-m", "service.cli", *words], env={**os.environ, "PYTHONPATH": str(repository)},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert answer.returncode == 0, answer.stderr[-2000:]
    assert len(read_results(folder)) == 2


def test_what_another_process_leaves_unfinished_is_taken_over(masks, tmp_path):
    cells = tuple(cells_of([3], ["thin"], [PriorName.PLAIN], [0], "variational"))
    effort = Effort(steps=8, calibrate=False, samples=0)
    plan = Sweep(CohortSource(masks=masks), CohortOptions(), cells, tmp_path, effort, DeviceName.CPU)
    other = multiprocessing.get_context("spawn").Process(
        target=hold_for, args=(tmp_path / "trainings" / cells[0].training_key, 4.0)
    )
    other.start()
    while not list(tmp_path.glob("trainings/*/lock")):
        time.sleep(0.02)
    work(plan)
    assert not (tmp_path / "results.jsonl").exists()
    work_together(plan)
    assert len(read_results(tmp_path)) == 1
    other.join()


def hold_for(folder, seconds):
    with held(folder):
        time.sleep(seconds)


class TestSideBySide:
    """On a CPU here; on a GPU each training has a stream of its own besides."""

    def plan(self, masks, folder, steps=8):
        cells = tuple(cells_of([3, 4], ["thin", "thick"], [PriorName.PLAIN, PriorName.FLOW_ARD], [0], "variational"))
        effort = Effort(steps=steps, calibrate=False, samples=0)
        return Sweep(CohortSource(masks=masks), CohortOptions(), cells, folder, effort, DeviceName.CPU)

    def weights(self, folder):
        found = {}
        for path in folder.glob("trainings/*/run/checkpoint.pt"):
            state = torch.load(path, weights_only=True)
            found[path.parts[-3]] = (state["step"], state["module"])
        return found

    def test_each_training_is_the_one_that_it_would_be_alone(self, masks, tmp_path):
        seen = []
        plan = self.plan(masks, tmp_path / "together")
        train_side_by_side(plan, seen.append)
        found = self.weights(plan.folder)
        assert len(found) == 4
        assert seen[-1] == Progress(begun=4, ended=4, steps=4 * 8, all_steps=4 * 8)
        for cell in {cell.training_key: cell for cell in plan.cells}.values():
            alone = replace(plan, cells=(cell,), folder=tmp_path / "alone")
            train_side_by_side(alone)
        for key, (step, module) in self.weights(tmp_path / "alone").items():
            assert step == found[key][0] == 8
            for name, value in module.items():
                torch.testing.assert_close(found[key][1][name], value)

    def test_what_is_there_and_what_another_holds_is_left(self, masks, tmp_path):
        plan = self.plan(masks, tmp_path)
        first = by_training(plan.cells)
        with held(tmp_path / "trainings" / next(iter(first))):
            train_side_by_side(plan)
        assert set(self.weights(tmp_path)) == set(list(first)[1:])
        times = {path: path.stat().st_mtime_ns for path in tmp_path.glob("trainings/*/run/checkpoint.pt")}
        train_side_by_side(plan)
        assert len(self.weights(tmp_path)) == 4
        assert all(path.stat().st_mtime_ns == time for path, time in times.items())

    def test_a_training_of_other_masks_is_not_taken_for_finished(self, masks, tmp_path):
        shutil.copytree(masks, tmp_path / "masks")
        plan = self.plan(tmp_path / "masks", tmp_path / "sweep")
        train_side_by_side(plan)
        nib.save(nib.Nifti1Image(ellipsoid(9).astype(np.uint8), np.eye(4)), tmp_path / "masks" / "train" / "e0.nii.gz")
        work(plan)
        assert len(refusals(plan)) == len(plan.cells)
        assert done(plan.folder) == set()

    def test_the_workers_record_why_one_is_refused(self, masks, tmp_path):
        train_side_by_side(self.plan(masks, tmp_path))
        other = self.plan(masks, tmp_path, steps=9)
        train_side_by_side(other)
        work(other)
        assert len(refusals(other)) == len(other.cells)
        assert all("other masks or settings" in words for words in refusals(other).values())
