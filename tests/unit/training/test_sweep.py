"""Sweeps and reports by the command line."""

import json
import re
import shutil
from dataclasses import asdict, replace

import nibabel as nib
import numpy as np
import pytest

from model.bundle import read_manifest, write_manifest
from tests.sweep_parts import EFFORT, QUICK, call, ellipsoid, write_masks
from training.calibration import calibrate_bundle_as
from training.cohorts import CohortOptions
from training.cohorts.sources import CohortSource, open_cohort
from training.prior_choice import chosen_parts
from training.pruning import PriorParts
from training.report import FIGURES
from training.reporting.chapters import pictured_seed
from training.sweep.cell import Place, adopt
from training.sweep.record import write_record
from training.sweep.table import append, read_results


@pytest.fixture(scope="module")
def masks(tmp_path_factory):
    return write_masks(tmp_path_factory.mktemp("masks"))


@pytest.fixture(scope="module")
def swept(masks, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep") / "out"
    words = ("sweep", "--masks", masks, *QUICK, "--output", folder, "--jobs", 1, "--json")
    return folder, words, call(*words)


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
