import zipfile
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from model.errors import ParityError
from model.networks.export import GraphSpec, check_parity, export_graphs, graph_specs
from model.networks.flow import FlowShape
from model.networks.prior import LatentPrior, PriorShape
from tests.random_networks import DECODER, PRIOR, Exported, jacobian, random_decoder, random_prior

pytestmark = [
    pytest.mark.xdist_group("exported"),
    pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"),
]

NAMES = [
    "decoder_logits",
    "decoder_jacobians",
    "prior_density",
    "prior_base_jacobian",
    "prior_sampling_0",
    "prior_sampling_1",
]


def spec_of(exported: Exported, name: str) -> GraphSpec:
    return next(spec for spec in graph_specs(exported.decoder, exported.prior) if spec.name == name)


def tuple_of(outputs):
    return outputs if isinstance(outputs, tuple) else (outputs,)


def test_every_graph_is_written_for_both_runtimes(exported):
    written = {path.name for path in exported.folder.iterdir()} - {"manifest.json", "population.npz"}
    scripted = {f"{name}.pt" for name in NAMES if name != "prior_base_jacobian"}
    assert written == {f"{name}.onnx" for name in NAMES} | scripted


def test_no_file_tells_where_it_was_made(exported, repository):
    for path in exported.folder.iterdir():
        data = path.read_bytes()
        if path.suffix == ".pt":
            with zipfile.ZipFile(path) as archive:
                data = b"".join(archive.read(name) for name in archive.namelist())
        assert str(repository).encode() not in data, path.name
        assert b"site-packages" not in data, path.name


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("batch", "points"), [(1, 1), (1, 900), (13, 2), (40, 33)])
def test_onnx_torch_and_torchscript_agree_at_any_size(exported, name, batch, points):
    spec = spec_of(exported, name)
    example = spec.example(3, DECODER.extent_mm, batch, points, seed=batch + points)
    expected = tuple_of(spec.module(*example))
    session = onnxruntime.InferenceSession(exported.folder / f"{name}.onnx", providers=["CPUExecutionProvider"])
    feeds = {key: value.numpy() for key, value in zip(spec.inputs, example, strict=True)}
    for key, want, found in zip(spec.outputs, expected, session.run(None, feeds), strict=True):
        assert np.abs(found - want.detach().numpy()).max() < 1e-4 * max(1.0, float(want.abs().max())), key
    if spec.scripted is not None:
        scripted = tuple_of(torch.jit.load(exported.folder / f"{name}.pt")(*example))
        for want, found in zip(tuple_of(spec.scripted(*example)), scripted, strict=True):
            assert (found - want).abs().max() < 1e-4 * max(1.0, float(want.abs().max()))


def test_gradient_and_jacobian_of_the_prior_are_those_of_automatic_differentiation(exported):
    (latent,) = spec_of(exported, "prior_density").example(3, 1.0, 6, 1, seed=4)
    density, gradient, base = spec_of(exported, "prior_density").module(latent)
    code = latent.clone().requires_grad_(True)
    torch.testing.assert_close(density, exported.prior.log_density(latent))
    torch.testing.assert_close(gradient, torch.autograd.grad(exported.prior.log_density(code).sum(), code)[0])
    again, found = spec_of(exported, "prior_base_jacobian").module(latent)
    torch.testing.assert_close(again, base)
    expected = jacobian(lambda z: exported.prior.to_base(z)[0], latent)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_graphs_of_other_weights_are_refused_by_name(exported, name):
    others = graph_specs(random_decoder(seed=1), random_prior(seed=1))
    other = next(spec for spec in others if spec.name == name)
    with pytest.raises(ParityError, match=f"of {name} differs between torch and ONNX Runtime"):
        check_parity(other, exported.folder, 3, DECODER.extent_mm)
    check_parity(spec_of(exported, name), exported.folder, 3, DECODER.extent_mm)


def test_one_changed_weight_in_a_file_is_noticed(exported, tmp_path):
    name = "decoder_logits"
    (tmp_path / f"{name}.pt").write_bytes((exported.folder / f"{name}.pt").read_bytes())
    graph = onnx.load(exported.folder / f"{name}.onnx")
    weight = next(item for item in graph.graph.initializer if list(item.dims) == [16])
    weight.CopyFrom(onnx.numpy_helper.from_array(onnx.numpy_helper.to_array(weight) + np.float32(0.01), weight.name))
    onnx.save(graph, tmp_path / f"{name}.onnx")
    with pytest.raises(ParityError, match="ONNX Runtime"):
        check_parity(spec_of(exported, name), tmp_path, 3, DECODER.extent_mm)


def test_a_torchscript_graph_of_other_weights_is_refused(exported, tmp_path):
    spec = spec_of(exported, "prior_sampling_0")
    (tmp_path / f"{spec.name}.onnx").write_bytes((exported.folder / f"{spec.name}.onnx").read_bytes())
    (tmp_path / f"{spec.name}.pt").write_bytes((exported.folder / "prior_sampling_1.pt").read_bytes())
    with pytest.raises(ParityError, match="TorchScript"):
        check_parity(spec, tmp_path, 3, DECODER.extent_mm)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("size", [1, 7, 11])
def test_a_code_may_have_any_size(size, tmp_path):
    """A number of codes or points that the graphs were traced with is not taken for the size of the code."""
    decoder = random_decoder(replace(DECODER, latent_size=size))
    flow = FlowShape(latent_size=size, transforms=1, bins=3, width=8)
    files = export_graphs(decoder, random_prior(PriorShape(flow)), tmp_path)
    assert "decoder_jacobians.onnx" in files
    session = onnxruntime.InferenceSession(tmp_path / "decoder_jacobians.onnx")
    latent, points = np.ones((2, size), np.float32), np.ones((2, 29, 3), np.float32)
    by_latent = session.run(["by_latent"], {"latent": latent, "points": points})[0]
    assert by_latent.shape == (2, 29, size)


def test_without_a_flow_there_is_nothing_to_invert():
    specs = graph_specs(random_decoder(), LatentPrior(replace(PRIOR, use_flow=False)))
    assert [spec.name for spec in specs] == NAMES[:4]
