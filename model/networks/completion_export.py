"""Write a completion network as ONNX and TorchScript graphs and check that both agree with it.

``completion``: drawn (1, 2, i, j, k), one where a voxel was drawn inside and outside -> logits (1, i, j, k), float32.
"""

import logging
from pathlib import Path

import onnxruntime
import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from model.bundle import COMPLETION
from model.errors import ParityError
from model.networks.completion import CompletionNet
from model.networks.export import compare, leave_out_source_places, quiet_exporter

#: Share of voxels that are drawn in the examples.
DRAWN = 0.05


def export_completion(net: CompletionNet, folder: Path) -> list[str]:
    """Write ``completion.onnx`` and ``completion.pt``; returns the file names.

    Raises:
        ParityError: torch, TorchScript and ONNX Runtime differ by more than `model.networks.export.PARITY_TOLERANCE`.
    """
    net = net.eval().requires_grad_(False).cpu()
    onnx, script = folder / f"{COMPLETION}.onnx", folder / f"{COMPLETION}.pt"
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with quiet_exporter():
        # As plain tensor operations: a graph of modules would hold where their sources lie.
        flat = make_fx(net)(_example(net, 0))
        program = torch.onnx.export(
            flat, (_example(net, 0),), dynamo=True, input_names=["drawn"], output_names=["logits"], verbose=False
        )
        torch.jit.save(torch.jit.trace(net, (_example(net, 0),), check_trace=False), script)
    if program is None:
        raise ParityError(f"{COMPLETION} could not be written as an ONNX graph.")
    onnx.write_bytes(program.model_proto.SerializeToString())
    leave_out_source_places(script)
    _check_parity(net, onnx, script)
    return [onnx.name, script.name]


def _check_parity(net: CompletionNet, onnx: Path, script: Path) -> None:
    session = onnxruntime.InferenceSession(onnx, providers=["CPUExecutionProvider"])
    scripted = torch.jit.load(script)
    for seed in range(1, 4):
        drawn = _example(net, seed)
        expected = [net(drawn).numpy()]
        compare(COMPLETION, "ONNX Runtime", expected, session.run(None, {"drawn": drawn.numpy()}))
        compare(COMPLETION, "TorchScript", expected, [scripted(drawn).numpy()])


def _example(net: CompletionNet, seed: int) -> Tensor:
    """Voxels drawn inside and outside at random."""
    chance = torch.rand(1, *net.shape.voxels, generator=torch.Generator().manual_seed(seed))
    return torch.stack([chance < DRAWN, chance > 1.0 - DRAWN], dim=1).float()
