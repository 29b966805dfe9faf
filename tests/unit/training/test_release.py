import hashlib
import json
import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from model.bundle import MANIFEST, open_bundle
from model.errors import InvalidParameter
from model.networks.decoder import DecoderShape
from model.networks.flow import FlowShape
from model.networks.prior import PriorShape
from tests.ellipsoid_cohort import GRID, ellipsoids
from training.autodecoder import AutoDecoder
from training.choices import DeviceName, ObjectiveName, RegimeName, TrainingChoice, configured
from training.cohorts import Case, Cohort, Provenance
from training.config import TrainingConfig
from training.pruning import PriorParts
from training.release import (
    STAGES,
    UNCALIBRATED_PRECISION,
    UNFINISHED,
    Naming,
    active_dimensions,
    export_run,
    load_module,
    wants_prior,
)
from training.runs import RECORD, half_extent, read_record, train_cohort
from training.seen import short_digest

CONFIG = TrainingConfig(
    decoder=DecoderShape(latent_size=3, width=8, depth=2),
    prior=PriorShape(FlowShape(latent_size=3), use_flow=False),
    steps=4,
    batch_shapes=3,
)


EGG = {"value": "102298001", "scheme": "SCT", "meaning": "Egg"}


def ellipsoid_cohort() -> Cohort:
    cases = tuple(Case(f"e{n}", f"e{n}", "train", shape.mask(GRID), GRID) for n, shape in enumerate(ellipsoids(4)))
    provenance = Provenance("made here", "CC0-1.0", "nobody", shippable=True)
    return Cohort("ellipsoids", cases, (), (), (), provenance)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("release") / "run"
    train_cohort(ellipsoid_cohort(), CONFIG, folder)
    return folder


@pytest.fixture(scope="module")
def released(run):
    output = run.parent / "bundle"
    levels = [logging.getLogger(name).level for name in ("onnxscript", "onnx_ir")]
    manifest = export_run(run, output, naming=Naming("egg", "3", EGG, 0.8))
    assert [logging.getLogger(name).level for name in ("onnxscript", "onnx_ir")] == levels
    return manifest, output


@pytest.mark.slow
class TestExport:
    def test_a_pruned_bundle_holds_the_live_dimensions_alone(self, run, tmp_path):
        manifest = export_run(run, tmp_path / "pruned", parts=PriorParts())
        facts = manifest.training["pruned"]
        opened = open_bundle(tmp_path / "pruned", threads=1)
        assert manifest.latent_size == len(manifest.sigmas) == len(facts["live"]) <= facts["dimensions_before"] == 3
        assert opened.population.codes.shape == opened.population.base_codes.shape == (4, manifest.latent_size)
        codes = opened.population.codes
        np.testing.assert_allclose(opened.prior.to_base(codes), opened.population.base_codes, atol=1e-5)
        assert opened.decoder.logits(codes, np.zeros((4, 1, 3))).shape == (4, 1)

    def test_the_manifest_is_the_one_that_was_written(self, released):
        manifest, output = released
        opened = open_bundle(output, threads=1)
        assert opened.manifest == manifest
        assert (manifest.name, manifest.version, manifest.structure) == ("egg", "3", "ellipsoids")
        assert (manifest.frame, manifest.units) == ("RAS", "mm")
        assert (manifest.licence, manifest.attribution) == ("CC0-1.0", "nobody")
        assert (manifest.anatomy, manifest.resolution_mm) == (EGG, 0.8)
        assert (manifest.likelihood_precision, manifest.accuracy) == (UNCALIBRATED_PRECISION, {})
        assert manifest.half_extent_mm == tuple(half_extent(ellipsoid_cohort()))
        assert manifest.active_dimensions == active_dimensions(np.array(manifest.sigmas))
        assert manifest.training["shapes"] == 4
        assert sorted(map(short_digest, ellipsoid_cohort().train)) == list(manifest.training_masks)

    def test_every_file_is_listed_with_its_hash(self, released):
        manifest, output = released
        found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in output.iterdir()}
        found.pop(MANIFEST)
        assert manifest.files == found

    def test_networks_and_population_are_those_of_the_run(self, run, released):
        manifest, output = released
        opened = open_bundle(output, threads=1)
        checkpoint = torch.load(run / "checkpoint.pt", weights_only=True)["module"]
        means = checkpoint["mean"] * checkpoint["prior.log_sigma"].exp()
        np.testing.assert_allclose(opened.population.codes, means.numpy(), rtol=1e-6)
        np.testing.assert_allclose(manifest.sigmas, checkpoint["prior.log_sigma"].exp().numpy())
        gaussian = torch.distributions.Normal(torch.zeros(3), checkpoint["prior.log_sigma"].exp())
        expected = gaussian.log_prob(means).sum(dim=1).numpy()
        np.testing.assert_allclose(opened.population.log_densities, expected, rtol=1e-5)
        np.testing.assert_allclose(opened.prior.log_density(opened.population.codes)[0], expected, rtol=1e-4)
        np.testing.assert_array_equal(opened.population.base_codes, opened.population.codes)
        volumes = [shape.volume_ml for shape in ellipsoids(4)]
        np.testing.assert_allclose(opened.population.volumes_ml, volumes, rtol=0.05)
        points = np.random.default_rng(0).normal(scale=8.0, size=(4, 20, 3))
        with torch.no_grad():
            module = load_module(run, read_record(run)[0], 4)
            logits = module.decoder(module.code_means(), torch.from_numpy(points).float()).numpy()
        np.testing.assert_allclose(opened.decoder.logits(opened.population.codes, points), logits, atol=1e-3)


class TestRefusals:
    def test_a_folder_with_something_in_it_is_left_alone(self, run, tmp_path):
        (tmp_path / "notes.txt").write_text("keep me")
        with pytest.raises(InvalidParameter, match="not empty") as caught:
            export_run(run, tmp_path)
        assert caught.value.part == "output"
        assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]

    def test_an_export_that_was_stopped_is_made_anew_in_the_same_folder(self, run, tmp_path):
        def stop(words):
            if words == STAGES[2]:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            export_run(run, tmp_path, watch=stop)
        assert list(tmp_path.iterdir()) == []
        (tmp_path / f"{UNFINISHED}killed").mkdir()
        export_run(run, tmp_path)
        assert open_bundle(tmp_path, threads=1).manifest.structure == "ellipsoids"
        assert not list(tmp_path.glob(f"{UNFINISHED}*"))

    def test_an_unfinished_run_is_refused_with_where_it_stands(self, run):
        with pytest.raises(InvalidParameter, match="stands at step 4 of 9") as caught:
            load_module(run, replace(CONFIG, steps=9), 4)
        assert caught.value.part == "run"

    def test_a_run_without_a_checkpoint_stands_at_its_start(self, tmp_path):
        with pytest.raises(InvalidParameter, match="stands at step 0 of 4"):
            load_module(tmp_path, CONFIG, 4)

    def test_a_folder_without_a_run_is_refused(self, tmp_path):
        with pytest.raises(InvalidParameter, match="no training run"):
            export_run(tmp_path, tmp_path / "out")
        assert not (tmp_path / "out").exists()


def test_a_loaded_module_is_ready_for_inference(run):
    module = load_module(run, CONFIG, 4)
    assert isinstance(module, AutoDecoder)
    assert not module.training
    assert module.mean.shape == (4, 3)


@pytest.mark.parametrize(
    ("objective", "flow", "ard", "wanted"),
    [
        (ObjectiveName.VARIATIONAL, None, None, True),
        (ObjectiveName.VARIATIONAL, True, None, False),
        (ObjectiveName.VARIATIONAL, None, True, False),
        (ObjectiveName.CENTRED, None, None, False),
        (ObjectiveName.CENTRED, False, False, True),
        (ObjectiveName.PAPER, False, False, False),
    ],
)
def test_export_fits_the_prior_that_was_not_trained_along(tmp_path, objective, flow, ard, wanted):
    choice = TrainingChoice(objective, RegimeName.DENSE, 3, flow=flow, ard=ard, device=DeviceName.CPU)
    config = configured(choice, reflected=False)
    (tmp_path / RECORD).write_text(json.dumps({"config": config.as_dict()}))
    assert wants_prior(tmp_path) is wanted
