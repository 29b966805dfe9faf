import numpy as np
import pytest
import torch

from model.bundle import read_manifest
from model.geometry import Grid
from model.inference.observations import MaskStack, Plane
from training.baselines.predecessor import AdamFit, AdamSettings, TorchDecoder, annotated_voxels, filled, fit_by_adam
from training.metrics_masks import dice

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")

GRID = Grid((36, 52, 46), np.array([[1.0, 0, 0, -18], [0, 1, 0, -26], [0, 0, 1, -23], [0, 0, 0, 1]]))


def drawn(mask, planes):
    seen = np.zeros(mask.shape, bool)
    for plane in planes:
        np.moveaxis(seen, plane.axis, 0)[plane.index] = True
    return MaskStack("mask[0]", GRID, mask & seen, ~seen)


@pytest.fixture(scope="module")
def decoder(shipped_bundles):
    (folder,) = [folder for folder in shipped_bundles if folder.name == "hippocampus"]
    return TorchDecoder(folder, read_manifest(folder)[0])


def test_every_annotated_voxel_counts_once():
    mask = np.random.default_rng(0).random(GRID.shape) < 0.3
    planes = (Plane(0, 0, 3), Plane(0, 1, 5))
    points, labels = annotated_voxels([drawn(mask, planes)], planes)
    assert len(points) == 52 * 46 + 36 * 46 - 46
    index = np.rint(GRID.to_index(points)).astype(int)
    np.testing.assert_array_equal(labels, mask[tuple(index.T)])


def test_adam_comes_towards_a_shape_of_the_family(decoder):
    torch.manual_seed(0)
    code = 0.2 * torch.randn(1, decoder.latent_size)
    mask = filled(decoder, AdamFit(code, torch.tensor([2.0, -1.0, 1.0])), GRID)
    planes = (Plane(0, 0, 18), Plane(0, 1, 26), Plane(0, 2, 23))
    fits = [fit_by_adam(decoder, [drawn(mask, planes)], planes, AdamSettings(steps=steps)) for steps in (1, 60)]
    first, last = (dice(mask, filled(decoder, found, GRID)) for found in fits)
    assert last > max(first, 0.85)
