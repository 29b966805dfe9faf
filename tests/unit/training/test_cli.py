"""The commands export, complete, calibrate and evaluate."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from model.bundle import open_bundle, read_manifest, write_manifest
from tests.cohort_parts import egg, write
from training.calibration import SHARES
from training.cohorts import CohortOptions
from training.cohorts.sources import CohortSource, open_cohort


@pytest.fixture(scope="module")
def bundle(tmp_path_factory, run):
    folder = tmp_path_factory.mktemp("bundle")
    for n in range(6):
        write(folder / "masks", f"e{n}", egg(n))
    words = ("train", "--masks", folder / "masks", "--steps", 150, "--latent-size", 3, "--device", "cpu")
    assert run(*words, "--output", folder / "run").exit_code == 0
    result = run(
        "export",
        folder / "run",
        "--output",
        folder / "out",
        "--name",
        "egg",
        "--version",
        "2.1",
        "--anatomy",
        "102298001 Egg",
        "--resolution-mm",
        "0.8",
        "--json",
    )
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["name"] == "egg"
    return folder / "out"


def held_out(masks, options):
    return [case.name for case in open_cohort(CohortSource(masks=masks), options).validation]


@pytest.mark.slow
class TestExport:
    def test_the_bundle_opens_and_says_what_it_was_made_of(self, bundle):
        opened = open_bundle(bundle)
        manifest = opened.manifest
        assert (manifest.name, manifest.version, manifest.latent_size) == ("egg", "2.1", 3)
        assert manifest.resolution_mm == 0.8
        assert manifest.anatomy == {"value": "102298001", "scheme": "SCT", "meaning": "Egg"}
        assert manifest.training["shapes"] == len(opened.population.codes) == 5
        assert np.allclose(opened.population.volumes_ml, 4 / 3 * np.pi * 0.72, rtol=0.2)
        assert np.all(np.array(manifest.half_extent_mm) >= 8.0)
        density, _ = opened.prior.log_density(opened.population.codes.astype(np.float32))
        assert np.allclose(density, opened.population.log_densities, rtol=1e-3, atol=1e-3)

    def test_nothing_is_written_over(self, run, bundle):
        result = run("export", bundle.parent / "run", "--output", bundle)
        assert result.exit_code == 2
        assert "not empty" in result.stderr

    @pytest.mark.parametrize("words", ["Talus", "67453005", "67453 Talus"])
    def test_an_anatomy_without_code_or_meaning_is_refused(self, run, bundle, tmp_path, words):
        result = run("export", bundle.parent / "run", "--output", tmp_path / "out", "--anatomy", words)
        assert result.exit_code == 2
        assert "67453005 Talus" in result.stderr

    def test_with_a_cohort_the_prior_is_chosen_on_its_validation_shapes(self, run, bundle, tmp_path):
        words = ("export", bundle.parent / "run", "--output", tmp_path / "out", "--masks", bundle.parent / "masks")
        result = run(*words)
        assert result.exit_code == 0, result.stderr
        assert "validation shapes come out" in result.stderr
        fitted = open_bundle(tmp_path / "out").manifest.training["pruned"]["fitted"]
        assert fitted["least_of_training"] in (0.5, 1.0)

    def test_the_prior_is_not_chosen_on_shapes_of_the_training(self, run, bundle, tmp_path):
        """Another seed holds out another shape, which this run was trained on."""
        words = ("export", bundle.parent / "run", "--output", tmp_path / "out", "--masks", bundle.parent / "masks")
        held = json.loads((bundle.parent / "run" / "run.json").read_text(encoding="utf-8"))["validation"]
        options = (CohortOptions(seed=seed) for seed in range(1, 9))
        others = (one for one in options if held_out(bundle.parent / "masks", one) != held)
        result = run(*words, "--seed", next(others).seed)
        assert result.exit_code == 2
        assert "was trained on" in result.stderr

    @pytest.mark.parametrize("option", ["--training-share", "--least-movement"])
    def test_what_would_be_pruned_is_said_where_something_is(self, run, bundle, tmp_path, option):
        words = ("export", bundle.parent / "run", "--output", tmp_path / "out", "--no-prune", option, 0.2)
        result = run(*words)
        assert result.exit_code == 2
        assert "Nothing is pruned" in result.stderr
        assert not (tmp_path / "out").exists()

    @pytest.mark.parametrize("option", [("--seed", 3), ("--align",), ("--skip-refused",), ("--test-fraction", 0.4)])
    def test_options_of_a_cohort_without_one_are_refused(self, run, bundle, tmp_path, option):
        result = run("export", bundle.parent / "run", "--output", tmp_path / "out", *option)
        assert result.exit_code == 2
        assert "would do nothing" in result.stderr

    def test_the_prior_is_not_chosen_on_another_cohort(self, run, bundle, tmp_path):
        for n in range(5):
            write(tmp_path / "masks", f"other{n}", egg(20 + n))
        result = run("export", bundle.parent / "run", "--output", tmp_path / "out", "--masks", tmp_path / "masks")
        assert result.exit_code == 2
        assert "trained on other shapes" in result.stderr

    def test_a_cohort_where_nothing_is_chosen_is_refused(self, run, bundle, tmp_path):
        words = ("export", bundle.parent / "run", "--output", tmp_path / "out", "--masks", bundle.parent / "masks")
        result = run(*words, "--no-prune")
        assert result.exit_code == 2
        assert "chooses how much" in result.stderr

    def test_a_cohort_without_validation_shapes_chooses_nothing(self, run, bundle, tmp_path):
        write(tmp_path / "masks", "only", egg(0))
        words = ("export", bundle.parent / "run", "--output", tmp_path / "out", "--masks", tmp_path / "masks")
        result = run(*words)
        assert result.exit_code == 2
        assert "no validation cases" in result.stderr

    def test_a_folder_without_a_run_is_refused(self, run, tmp_path):
        assert run("export", tmp_path, "--output", tmp_path / "out").exit_code == 2


@pytest.fixture(scope="module")
def completed(tmp_path_factory, run, bundle):
    folder = tmp_path_factory.mktemp("completed")
    shutil.copytree(bundle, folder / "bundle")
    words = ("complete", folder / "bundle", "--masks", bundle.parent / "masks", "--steps", 20, "--run", folder / "run")
    result = run(*words, "--device", "cpu", "--json")
    assert result.exit_code == 0, result.stderr
    return folder, json.loads(result.stdout)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
class TestComplete:
    def test_the_bundle_has_the_network_and_says_what_it_was_trained_on(self, completed):
        folder, told = completed
        manifest, _ = read_manifest(folder / "bundle")
        assert told["voxels"] == manifest.completion["voxels"]
        assert (manifest.completion["training"]["shapes"], manifest.completion["training"]["steps"]) == (5, 20)
        assert {"completion.onnx", "completion.pt"} <= manifest.files.keys()
        assert open_bundle(folder / "bundle").completer.lattice.voxels == tuple(told["voxels"])
        assert "/" not in json.dumps(manifest.completion)
        assert manifest.accuracy == {}

    def test_a_finished_training_is_taken_as_it_is(self, completed, run, bundle, tmp_path):
        folder, _ = completed
        other = shutil.copytree(bundle, tmp_path / "other")
        words = ("complete", other, "--masks", bundle.parent / "masks", "--steps", 20, "--run", folder / "run")
        assert run(*words, "--device", "cpu").exit_code == 0
        assert (other / "completion.onnx").read_bytes() == (folder / "bundle" / "completion.onnx").read_bytes()

    def test_a_training_of_other_masks_or_settings_is_not_written_over(self, completed, run, bundle):
        folder, _ = completed
        before = (folder / "run" / "completion.pt").read_bytes()
        words = ("complete", folder / "bundle", "--masks", bundle.parent / "masks", "--run", folder / "run")
        settings = (("--steps", 21), "other masks or settings")
        masks = (("--steps", 20, "--seed", 1), "which the network would learn from")
        for other, sentence in (settings, masks):
            result = run(*words, *other, "--device", "cpu")
            assert result.exit_code == 2
            assert sentence in result.stderr
        assert (folder / "run" / "completion.pt").read_bytes() == before

    def test_calibration_chooses_its_weight_by_validation_shapes(self, completed, run, bundle, tmp_path):
        folder = shutil.copytree(completed[0] / "bundle", tmp_path / "calibrated")
        result = run("calibrate", folder, "--masks", bundle.parent / "masks", "--json")
        assert result.exit_code == 0, result.stderr
        manifest, _ = read_manifest(folder)
        errors, share = manifest.calibration["asd_mm_by_share"], manifest.completion["share"]
        assert [float(tried) for tried in errors] == list(SHARES)
        assert errors[f"{share:g}"] == min(errors.values())
        told = json.loads(result.stdout)
        assert (told["completion_share"], told["spread_mm"]) == (share, manifest.discrepancy["spread_mm"])
        spreads = manifest.calibration["cross_entropy_by_spread"]
        assert float(min(spreads, key=spreads.__getitem__)) == manifest.discrepancy["spread_mm"]
        factors = manifest.calibration["cross_entropy_by_sharpness"]
        assert float(min(factors, key=factors.__getitem__)) == manifest.posterior["sharpness"]
        before = (folder / "manifest.json").read_bytes()
        assert run("calibrate", folder, "--masks", bundle.parent / "masks").exit_code == 0
        assert (folder / "manifest.json").read_bytes() == before

    def test_a_model_without_one_has_no_weight_to_choose(self, run, bundle, tmp_path):
        plain = shutil.copytree(bundle, tmp_path / "plain")
        write_manifest(replace(read_manifest(plain)[0], accuracy={"test/thin": {"dice": 0.9}}), plain)
        result = run("calibrate", plain, "--masks", bundle.parent / "masks", "--json")
        assert result.exit_code == 0, result.stderr
        manifest, _ = read_manifest(plain)
        assert (manifest.completion, manifest.accuracy) == ({}, {})
        assert "completion_share" not in json.loads(result.stdout)

    def test_a_folder_without_a_bundle_is_refused_before_anything_is_trained(self, run, masks, tmp_path):
        result = run("complete", tmp_path, "--masks", masks, "--run", tmp_path / "run", "--steps", 5)
        assert result.exit_code != 0
        assert "has no manifest.json" in result.stderr
        assert not (tmp_path / "run").exists()


@pytest.mark.slow
class TestEvaluate:
    def test_table_json_and_csv_agree(self, run, bundle, masks, tmp_path):
        words = ("evaluate", "--model", bundle, "--masks", masks, "--regime", "thin", "--regime", "orthogonal")
        result = run(*words, "--json", "--output", tmp_path / "new" / "cases.csv")
        assert result.exit_code == 0, result.stderr
        rows = json.loads(result.stdout)
        assert [(row["regime"], row["method"]) for row in rows] == [
            ("thin", "model"),
            ("thin", "signed distance"),
            ("thin", "ITK contours"),
            ("orthogonal", "model"),
            ("orthogonal", "ITK contours"),
        ]
        with (tmp_path / "new" / "cases.csv").open() as stream:
            lines = list(csv.DictReader(stream))
        assert [line["case"] for line in lines] == ["e6"] * 5
        assert [float(line["dice"]) for line in lines] == pytest.approx(
            [row["figures"]["dice"]["mean"] for row in rows]
        )
        (tmp_path / "new" / "cases.csv").write_text("of another time")
        text = run(*words, "--output", tmp_path / "new" / "cases.csv", "--force")
        assert text.exit_code == 0
        assert len(text.stdout.splitlines()) == 6
        assert len((tmp_path / "new" / "cases.csv").read_text().splitlines()) == 6

    def test_validation_cases_can_be_measured_and_limited(self, run, bundle, masks):
        words = ("evaluate", "--model", bundle, "--masks", masks, "--split", "validation", "--limit", 1)
        result = run(*words, "--regime", "dense", "--json")
        assert result.exit_code == 0, result.stderr
        assert [row["cases"] for row in json.loads(result.stdout)] == [1]

    def test_an_unknown_model_is_refused(self, run, masks):
        result = run("evaluate", "--model", "spleen", "--masks", masks)
        assert result.exit_code == 2
        assert "No such model" in result.stderr

    def test_a_split_without_cases_is_refused(self, run, bundle, tmp_path):
        for n in range(4):
            write(tmp_path / "train", f"e{n}", egg(n))
        result = run("evaluate", "--model", bundle, "--masks", tmp_path)
        assert result.exit_code == 2
        assert "no test cases; train with --test-fraction" in result.stderr

    def test_shapes_of_the_training_are_not_measured_on(self, run, bundle):
        masks = bundle.parent / "masks"
        before = (bundle / "manifest.json").read_bytes()
        held = json.loads((bundle.parent / "run" / "run.json").read_text(encoding="utf-8"))["validation"]
        options = (CohortOptions(seed=seed) for seed in range(1, 9))
        seed = next(one.seed for one in options if held_out(masks, one) != held)
        for words in (
            ("calibrate", bundle, "--seed", seed),
            ("evaluate", "--model", bundle, "--split", "validation", "--seed", seed),
            ("evaluate", "--model", bundle, "--test-fraction", 0.4),
        ):
            result = run(*words, "--masks", masks)
            assert result.exit_code == 2
            assert "was trained on" in result.stderr
            assert "--test-fraction" in result.stderr
        assert (bundle / "manifest.json").read_bytes() == before
