"""Write decoder and prior as ONNX and TorchScript graphs and check that all agree.

Graphs (batch ``b`` and points ``n`` dynamic, float32):

- ``decoder_logits``: latent (b, D), points (b, n, 3) mm -> logits (b, n)
- ``decoder_jacobians``: the same -> logits, by_latent (b, n, D), by_point (b, n, 3) per mm
- ``prior_density``: latent (b, D) -> log_density (b), gradient (b, D), base (b, D)
- ``prior_base_jacobian``: latent (b, D) -> base (b, D), jacobian (b, D, D) of base by latent
- ``prior_sampling_K``: target (b, D), guess (b, D) -> next guess (b, D), one graph for each transform K of the flow;
  the autoregressive inverse as a fixed point, exact after at most D steps
"""

import logging
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor, nn
from torch.export import Dim
from torch.fx.experimental.proxy_tensor import make_fx

from model.errors import ParityError
from model.networks.decoder import OccupancyDecoder
from model.networks.flow import SplineTransform
from model.networks.prior import LatentPrior
from model.networks.torchscript import TorchDecoder, TorchPrior

#: Largest difference between torch, TorchScript and ONNX Runtime, relative to the size of the output (and 1).
PARITY_TOLERANCE = 1e-4


class LogitsGraph(nn.Module):
    """``decoder_logits``."""

    def __init__(self, decoder: OccupancyDecoder) -> None:
        super().__init__()
        self.decoder = decoder

    def forward(self, latent: Tensor, points: Tensor) -> Tensor:
        """Logits."""
        result: Tensor = self.decoder(latent, points)
        return result


class JacobiansGraph(nn.Module):
    """``decoder_jacobians``."""

    def __init__(self, decoder: OccupancyDecoder) -> None:
        super().__init__()
        self.decoder = decoder

    def forward(self, latent: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Logits and derivatives."""
        return self.decoder.jacobians(latent, points)


class DensityGraph(nn.Module):
    """``prior_density``: the gradient is recorded as plain operations by tracing automatic differentiation."""

    def __init__(self, prior: LatentPrior) -> None:
        super().__init__()
        self.prior = prior

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log density, its gradient and base coordinates."""

        def total(value: Tensor) -> tuple[Tensor, tuple[Tensor, Tensor]]:
            base, log_det = self.prior.to_base(value)
            density = self.prior.base_log_density(base) + log_det
            return density.sum(), (density, base)

        gradient, (density, base) = torch.func.grad(total, has_aux=True)(latent)
        return density, gradient, base


class BaseJacobianGraph(nn.Module):
    """``prior_base_jacobian``."""

    def __init__(self, prior: LatentPrior) -> None:
        super().__init__()
        self.prior = prior

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Base coordinates and their Jacobian."""
        return self.prior.base_jacobian(latent)


class ScriptedDensity(nn.Module):
    """TorchScript's form of ``prior_density``: without the gradient, which automatic differentiation gives there."""

    def __init__(self, prior: LatentPrior) -> None:
        super().__init__()
        self.prior = prior

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Log density and base coordinates."""
        base, log_det = self.prior.to_base(latent)
        return self.prior.base_log_density(base) + log_det, base


class SamplingStepGraph(nn.Module):
    """``prior_sampling_K``, in the prior's own units before and after."""

    scale: Tensor

    def __init__(self, transform: SplineTransform, scale: Tensor) -> None:
        super().__init__()
        self.transform = transform
        self.register_buffer("scale", scale.detach().clone())

    def forward(self, target: Tensor, guess: Tensor) -> Tensor:
        """The next guess."""
        return self.transform.inverse_step(target / self.scale, guess / self.scale) * self.scale


@dataclass(frozen=True)
class GraphSpec:
    """A graph to export: its module, inputs and outputs by name, what TorchScript traces, and the latents' units."""

    name: str
    module: nn.Module
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    scripted: nn.Module | None
    units: Tensor

    def example(self, latent_size: int, extent_mm: float, batch: int, points: int, seed: int) -> tuple[Tensor, ...]:
        """Random inputs of the given sizes; latents as far out as the prior draws them."""
        random = torch.Generator().manual_seed(seed)
        sizes = {name: (batch, points, 3) if name == "points" else (batch, latent_size) for name in self.inputs}
        scales = {name: extent_mm if name == "points" else self.units for name in self.inputs}
        return tuple(scales[n] * torch.randn(*sizes[n], generator=random).clamp(-2, 2) for n in self.inputs)

    def traced_example(self, latent_size: int, extent_mm: float) -> tuple[Tensor, ...]:
        """Inputs to trace with; numbers of codes and points differ from the code's size, or would be taken for it."""
        batch, points = (7, 11) if latent_size not in (7, 11) else (13, 17)
        return self.example(latent_size, extent_mm, batch, points, seed=0)


def graph_specs(decoder: OccupancyDecoder, prior: LatentPrior) -> list[GraphSpec]:
    """All graphs of a bundle."""
    logits, jacobians, density = LogitsGraph(decoder), JacobiansGraph(decoder), DensityGraph(prior)
    transforms = prior.flow.transforms if prior.shape.use_flow else ()
    steps = [SamplingStepGraph(transform, prior.flow_scale()) for transform in transforms]
    where, derivatives = ("latent", "points"), ("logits", "by_latent", "by_point")
    units = prior.sigma.detach()
    return [
        GraphSpec("decoder_logits", logits, where, ("logits",), logits, units),
        GraphSpec("decoder_jacobians", jacobians, where, derivatives, jacobians, units),
        GraphSpec(
            "prior_density", density, ("latent",), ("log_density", "gradient", "base"), ScriptedDensity(prior), units
        ),
        GraphSpec("prior_base_jacobian", BaseJacobianGraph(prior), ("latent",), ("base", "jacobian"), None, units),
        *(GraphSpec(f"prior_sampling_{k}", s, ("target", "guess"), ("next",), s, units) for k, s in enumerate(steps)),
    ]


def torch_networks(decoder: OccupancyDecoder, prior: LatentPrior) -> tuple[TorchDecoder, TorchPrior]:
    """The same graphs as they are, unexported, for inference here and now."""
    decoder, prior = decoder.eval().requires_grad_(False).cpu(), prior.eval().requires_grad_(False).cpu()
    graphs = {spec.name: spec.scripted for spec in graph_specs(decoder, prior) if spec.scripted is not None}
    size = decoder.shape.latent_size
    steps = [graph for name, graph in graphs.items() if name.startswith("prior_sampling_")]
    return (
        TorchDecoder(size, graphs["decoder_logits"], graphs["decoder_jacobians"]),
        TorchPrior(size, graphs["prior_density"], steps),
    )


def export_graphs(decoder: OccupancyDecoder, prior: LatentPrior, folder: Path) -> list[str]:
    """Write every graph as ``NAME.onnx`` and ``NAME.pt`` (TorchScript); returns the file names.

    Raises:
        ParityError: torch, TorchScript and ONNX Runtime differ by more than `PARITY_TOLERANCE`.
    """
    decoder, prior = decoder.eval().requires_grad_(False).cpu(), prior.eval().requires_grad_(False).cpu()
    size, extent = decoder.shape.latent_size, decoder.shape.extent_mm
    written: list[str] = []
    for spec in graph_specs(decoder, prior):
        flat = _flattened(spec, size, extent)
        (folder / f"{spec.name}.onnx").write_bytes(_onnx_bytes(spec, flat, size, extent))
        written.append(f"{spec.name}.onnx")
        if spec.scripted is not None:
            torch.jit.save(_scripted(spec.scripted, spec, size, extent), folder / f"{spec.name}.pt")
            leave_out_source_places(folder / f"{spec.name}.pt")
            written.append(f"{spec.name}.pt")
        check_parity(spec, folder, size, extent)
    return written


@contextmanager
def quiet_exporter() -> Iterator[None]:
    """Keep the exporter's remarks on its own inner workings from the caller."""
    talkers = [logging.getLogger(name) for name in ("onnxscript", "onnx_ir")]
    levels = [talker.level for talker in talkers]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for talker in talkers:
            talker.setLevel(logging.ERROR)
        try:
            yield
        finally:
            for talker, level in zip(talkers, levels, strict=True):
                talker.setLevel(level)


def _flattened(spec: GraphSpec, size: int, extent: float) -> nn.Module:
    """The module as plain tensor operations with symbolic sizes, automatic differentiation included."""
    example = spec.traced_example(size, extent)
    return make_fx(spec.module, tracing_mode="symbolic", _allow_non_fake_inputs=True)(*example)


def _onnx_bytes(spec: GraphSpec, flat: nn.Module, size: int, extent: float) -> bytes:
    batch, points = Dim("b", min=1, max=4096), Dim("n", min=1, max=1 << 24)
    shapes = [{0: batch, 1: points} if name == "points" else {0: batch} for name in spec.inputs]
    example = spec.traced_example(size, extent)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    program = torch.export.export(flat, example, dynamic_shapes=tuple(shapes))
    exported = torch.onnx.export(
        program, dynamo=True, input_names=spec.inputs, output_names=spec.outputs, optimize=True, verbose=False
    )
    if exported is None:
        raise ParityError(f"{spec.name} could not be written as an ONNX graph.")
    return bytes(exported.model_proto.SerializeToString())


def _scripted(module: nn.Module, spec: GraphSpec, size: int, extent: float) -> torch.jit.ScriptModule:
    example = spec.traced_example(size, extent)
    traced: torch.jit.ScriptModule = torch.jit.trace(module, example, check_trace=False)
    return traced


def leave_out_source_places(path: Path) -> None:
    """Rewrite a TorchScript archive without its debug records, which name folders of the exporting machine."""
    with zipfile.ZipFile(path) as archive:
        kept = {name: archive.read(name) for name in archive.namelist() if not name.endswith(".debug_pkl")}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, content in kept.items():
            archive.writestr(zipfile.ZipInfo(name), content)


def check_parity(spec: GraphSpec, folder: Path, size: int, extent: float) -> None:
    """Compare a graph's files with its module at several batch sizes and numbers of points.

    Raises:
        ParityError: they differ by more than `PARITY_TOLERANCE`.
    """
    session = onnxruntime.InferenceSession(folder / f"{spec.name}.onnx", providers=["CPUExecutionProvider"])
    for batch, points in ((1, 1), (2, 257), (5, 64)):
        example = spec.example(size, extent, batch, points, seed=batch)
        expected = _as_arrays(spec.module(*example))
        feeds = {name: value.numpy() for name, value in zip(spec.inputs, example, strict=True)}
        compare(spec.name, "ONNX Runtime", expected, session.run(None, feeds))
        if spec.scripted is not None:
            scripted = torch.jit.load(folder / f"{spec.name}.pt")
            compare(spec.name, "TorchScript", _as_arrays(spec.scripted(*example)), _as_arrays(scripted(*example)))


def _as_arrays(outputs: Tensor | Sequence[Tensor]) -> list[np.ndarray]:
    sequence = [outputs] if isinstance(outputs, Tensor) else outputs
    return [value.detach().numpy() for value in sequence]


def compare(name: str, runtime: str, expected: Sequence[np.ndarray], found: Sequence[np.ndarray]) -> None:
    """Whether a runtime's outputs are the network's.

    Raises:
        ParityError: they differ by more than `PARITY_TOLERANCE`.
    """
    for number, (a, b) in enumerate(zip(expected, found, strict=True)):
        gap = float(np.abs(a - b).max() / max(1.0, np.abs(a).max()))
        if not gap <= PARITY_TOLERANCE:
            raise ParityError(
                f"Output {number} of {name} differs between torch and {runtime} by {gap:.1e}; "
                f"at most {PARITY_TOLERANCE:.0e} is accepted."
            )
