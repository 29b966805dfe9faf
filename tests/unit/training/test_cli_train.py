"""The commands train and report."""

import json

import numpy as np
import pytest

from tests.cohort_parts import egg, write

SMALL = ["--steps", "6", "--latent-size", "3", "--device", "cpu"]


class TestTrain:
    def test_json_says_what_was_trained_on(self, run, masks, tmp_path):
        result = run("train", "--masks", masks, *SMALL, "--regime", "thin", "--output", tmp_path / "run", "--json")
        assert result.exit_code == 0, result.stderr
        summary = json.loads(result.stdout)
        assert (summary["train"], summary["validation"], summary["steps"]) == (5, 1, 6)
        assert np.isfinite(summary["figures"]["loss"])

    def test_a_refused_file_stops_the_training_and_is_named_with_its_reason(self, run, masks, tmp_path):
        index = np.stack(np.meshgrid(*[np.arange(90)] * 3, indexing="ij"), axis=-1)
        write(masks / "train", "whale", ((index - 44.5) ** 2).sum(axis=-1) <= 40**2)
        words = ("train", "--masks", masks, *SMALL, "--output", tmp_path / "run")
        stopped = run(*words)
        assert stopped.exit_code == 2
        assert "whale: it does not belong to the cohort: volume" in stopped.stderr
        assert "--skip-refused goes on without them" in stopped.stderr
        assert not (tmp_path / "run").exists()
        skipped = run(*words, "--skip-refused", "--json")
        assert skipped.exit_code == 0
        assert list(json.loads(skipped.stdout)["refused"]) == ["whale"]

    def test_no_bar_and_no_control_sequences_in_a_pipe(self, run, masks, tmp_path):
        result = run("train", "--masks", masks, *SMALL, "--output", tmp_path / "run")
        assert result.exit_code == 0
        assert "\x1b" not in result.output
        assert "\r" not in result.output
        assert len(result.stdout.splitlines()) == 1

    def test_a_folder_without_a_run_is_not_resumed(self, run, masks, tmp_path):
        result = run("train", "--masks", masks, *SMALL, "--output", tmp_path / "run", "--resume")
        assert result.exit_code == 2
        assert "holds no run to resume" in result.stderr
        assert not (tmp_path / "run").exists()

    def test_a_finished_run_is_resumed_without_a_step(self, run, masks, tmp_path):
        words = ("train", "--masks", masks, *SMALL, "--output", tmp_path / "run", "--json")
        assert run(*words).exit_code == 0
        assert run(*words).exit_code == 2
        again = run(*words, "--resume")
        assert again.exit_code == 0
        assert json.loads(again.stdout)["figures"] == {}

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            ((), "exactly one is accepted"),
            (("--cohort", "talus", "--masks", "."), "exactly one is accepted"),
            (("--cohort", "talus", "--data", "nowhere"), "data folder does not exist"),
            (("--masks", "nowhere"), "folder of masks does not exist"),
            (("--masks", ".", "--shippable"), "--shippable goes with --cohort"),
        ],
    )
    def test_bad_input_ends_with_2_and_one_sentence(self, run, words, sentence):
        result = run("train", *words)
        assert result.exit_code == 2
        assert sentence in result.stderr
        assert "Traceback" not in result.output

    def test_what_stands_in_the_way_is_told_before_the_cohort_is_opened(self, run, tmp_path):
        (tmp_path / "file").write_text("here")
        (tmp_path / "run").mkdir()
        (tmp_path / "run" / "run.json").write_text("{}")
        for words, sentence in (
            (("train", "--output", tmp_path / "file" / "x"), "output cannot be written"),
            (("train", "--output", tmp_path / "run"), "holds a run already"),
            (("calibrate", tmp_path / "gone"), "folder of the bundle does not exist"),
            (("complete", tmp_path / "gone"), "folder of the bundle does not exist"),
            (("calibrate", tmp_path), "has no manifest.json"),
            (("evaluate", "--model", tmp_path / "gone"), "folder of the model does not exist"),
            (("evaluate", "--model", "talus", "--output", tmp_path / "file" / "x"), "output cannot be written"),
            (("evaluate", "--model", "talus", "--output", tmp_path / "file"), "file exists; another name, or --force"),
            (("evaluate", "--model", "talus", "--record", "--limit", 1), "without --limit and --offset"),
            (("evaluate", "--model", "talus", "--record", "--offset", 0), "without --limit and --offset"),
        ):
            result = run(*words, "--masks", "nowhere")
            assert result.exit_code == 2
            assert sentence in result.stderr
        assert (tmp_path / "file").read_text() == "here"

    def test_patience_without_validation_shapes_is_refused(self, run, masks, tmp_path):
        """All shapes are one person's, of whom none can be held out."""
        lines = [f"e{n},one,train" for n in range(6)] + ["e6,other,test"]
        (masks / "cases.csv").write_text("\n".join(["case,person,split", *lines]))
        words = ("train", "--masks", masks, *SMALL, "--output", tmp_path / "run")
        result = run(*words, "--patience", 2)
        assert result.exit_code == 2
        assert "no validation cases by which a training could end early" in result.stderr
        assert not (tmp_path / "run").exists()
        assert run(*words, "--patience", 0).exit_code == 0

    def test_a_single_shape_is_refused_and_few_are_told_of(self, run, masks, tmp_path):
        write(tmp_path / "one", "e", egg(0))
        assert "cannot tell how shapes differ" in run("train", "--masks", tmp_path / "one", *SMALL).stderr
        result = run("train", "--masks", masks, *SMALL, "--output", tmp_path / "run")
        assert "note: 5 training shapes are few" in result.stderr

    def test_reports_name_the_folder_at_fault(self, run, tmp_path):
        (tmp_path / "empty").mkdir()
        for folder, words in (("gone", "does not exist"), ("empty", "holds no results")):
            result = run("report", tmp_path / folder, "--output", tmp_path / "page.html")
            assert result.exit_code == 2
            assert f"Folder 1 of 1 ({folder}) {words}" in result.stderr

    def test_steps_and_epochs_exclude_each_other(self, run, masks):
        result = run("train", "--masks", masks, *SMALL, "--epochs", 2)
        assert result.exit_code == 2
        assert "epochs" in result.stderr

    def test_an_unknown_choice_is_refused(self, run):
        assert run("train", "--cohort", "spleen").exit_code == 2
        assert run("train", "--cohort", "talus", "--regime", "sparse").exit_code == 2
