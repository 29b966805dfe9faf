"""Bundles with a network that completes drawings."""

import json
import shutil

import numpy as np
import pytest
import torch

from model.bundle import MANIFEST, open_bundle, read_manifest, write_manifest
from model.errors import BundleCorrupt, BundleIncomplete
from model.networks.completion import CompletionNet, CompletionShape
from model.networks.completion_export import export_completion
from tests.random_networks import manifest_of

pytestmark = [
    pytest.mark.xdist_group("exported"),
    pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"),
]
VOXELS = (8, 16, 8)


@pytest.fixture(scope="module")
def completed(exported, tmp_path_factory):
    folder = shutil.copytree(exported.folder, tmp_path_factory.mktemp("completed") / "bundle")
    torch.manual_seed(0)
    export_completion(CompletionNet(CompletionShape(VOXELS, width=4)), folder)
    return folder


def described(folder, there, **completion):
    """A copy whose manifest says this of the network."""
    shutil.copytree(folder, there)
    files = [path.name for path in there.iterdir() if path.name != MANIFEST]
    write_manifest(manifest_of(there, files), there)
    values = json.loads((there / MANIFEST).read_text())
    (there / MANIFEST).write_text(json.dumps({**values, "completion": completion}))
    return there


@pytest.mark.parametrize("backend", ["onnx", "torchscript"])
def test_the_network_is_opened_with_the_bundle(completed, tmp_path, backend):
    folder = described(completed, tmp_path / "b", voxels=list(VOXELS), step_mm=1.25, share=0.5)
    model = open_bundle(folder, backend=backend, threads=1)
    assert (model.completer.lattice.voxels, model.completer.lattice.step_mm) == (VOXELS, 1.25)
    assert model.completer.logits(np.zeros((2, *VOXELS), bool)).shape == VOXELS
    assert read_manifest(folder)[0].completion["share"] == 0.5


def test_bundles_without_one_open_as_ever(exported):
    assert open_bundle(exported.folder).completer is None


def test_a_graph_that_is_not_listed_is_refused(exported, tmp_path):
    folder = described(exported.folder, tmp_path / "b", voxels=list(VOXELS), step_mm=1.0, share=0.5)
    with pytest.raises(BundleIncomplete, match=r"lists no completion\.onnx"):
        open_bundle(folder)


@pytest.mark.parametrize(
    "completion",
    [
        {"share": 0.5},
        {"voxels": [8, 16], "step_mm": 1.0},
        {"voxels": "all", "step_mm": 1.0},
        {"voxels": 3, "step_mm": {}},
    ],
)
def test_a_lattice_that_cannot_be_read_is_told_of(completed, tmp_path, completion):
    with pytest.raises(BundleCorrupt, match="on which lattice"):
        open_bundle(described(completed, tmp_path / "b", **completion))
