"""The completion network and its exported graphs."""

import numpy as np
import pytest
import torch

from model.backends import onnx_completer, torchscript_completer
from model.errors import ParityError
from model.geometry import CanonicalLattice
from model.networks.completion import CompletionNet, CompletionShape, blocks_of, voxels_of
from model.networks.completion_export import export_completion

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
SHAPE = CompletionShape((16, 8, 24), width=8)
LATTICE = CanonicalLattice(SHAPE.voxels, 1.5)


def network(seed=0):
    torch.manual_seed(seed)
    return CompletionNet(SHAPE).eval()


def drawing(seed=0):
    chance = np.random.default_rng(seed).random(SHAPE.voxels)
    return np.stack([chance < 0.1, chance > 0.8])


def test_blocks_and_voxels_are_inverse():
    value = torch.randn(2, 3, 4, 6, 8)
    blocks = blocks_of(value)
    assert blocks.shape == (2, 24, 2, 3, 4)
    torch.testing.assert_close(voxels_of(blocks), value, rtol=0.0, atol=0.0)
    torch.testing.assert_close(blocks[1, 8:16, 1, 2, 3], value[1, 1, 2:4, 4:6, 6:8].reshape(8), rtol=0.0, atol=0.0)


def test_every_voxel_gets_a_logit_that_depends_on_the_drawing_and_on_the_place():
    net = network()
    with torch.no_grad():
        empty = net(torch.zeros(1, 2, *SHAPE.voxels))
        drawn = net(torch.from_numpy(drawing()[None]).float())
    assert drawn.shape == (1, *SHAPE.voxels)
    assert (drawn != empty).float().mean() > 0.99
    assert empty.std() > 1e-3


def test_samples_of_a_batch_do_not_see_each_other():
    net = network()
    drawn = torch.from_numpy(np.stack([drawing(1), drawing(2)])).float()
    with torch.no_grad():
        torch.testing.assert_close(net(drawn)[1:], net(drawn[1:]), rtol=1e-4, atol=1e-5)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("completion")
    assert export_completion(network(), folder) == ["completion.onnx", "completion.pt"]
    return folder


def test_onnx_runtime_and_torchscript_answer_as_the_network_does(exported):
    with torch.no_grad():
        expected = network()(torch.from_numpy(drawing(3)[None]).float())[0].numpy()
    for open_graph, name in ((onnx_completer, "completion.onnx"), (torchscript_completer, "completion.pt")):
        found = open_graph(exported / name, LATTICE, 1)
        assert found.lattice == LATTICE
        np.testing.assert_allclose(found.logits(drawing(3)), expected, atol=1e-4)


class CountingNet(CompletionNet):
    """Answers differently each time, as no graph can."""

    calls = 0

    def forward(self, drawn):
        self.calls += 1
        return super().forward(drawn) + self.calls


def test_a_graph_that_differs_is_refused(tmp_path):
    with pytest.raises(ParityError, match="completion differs"):
        export_completion(CountingNet(SHAPE), tmp_path)


def test_graphs_name_no_folder_of_the_exporting_machine(exported, repository):
    for path in exported.iterdir():
        assert str(repository).encode() not in path.read_bytes()
