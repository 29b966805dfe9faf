"""What inference needs of a network: the `Decoder`, `Prior` and `Completer` protocols.

ONNX Runtime stands behind them by default, TorchScript when asked for. Batches lead: ``b`` shapes
(starts, ensemble members, samples) are evaluated in one call, each with its own latent code.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import onnxruntime
from jaxtyping import Bool, Float

from model.chunks import Array, Network, Workers
from model.errors import BundleCorrupt, BundleError
from model.geometry import CanonicalLattice


@runtime_checkable
class Decoder(Protocol):
    """Occupancy decoder ``f_theta(z, u)`` before its sigmoid, over canonical points (mm)."""

    latent_size: int

    def logits(self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n"]:
        """Occupancy logits; positive inside."""
        ...

    def logits_and_jacobians(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n d"], Float[np.ndarray, "b n 3"]]:
        """Logits with their derivatives by latent code and by point (per mm)."""
        ...

    def logits_and_gradients(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n 3"]]:
        """Logits with their derivatives by point (per mm)."""
        ...


@runtime_checkable
class Prior(Protocol):
    """Density of latent codes: a normalizing flow onto a diagonal Gaussian."""

    latent_size: int

    def log_density(self, latent: Float[np.ndarray, "b d"]) -> tuple[Float[np.ndarray, "b"], Float[np.ndarray, "b d"]]:
        """``log p(z)`` (nats) and its gradient."""
        ...

    def to_base(self, latent: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
        """``z0 = g(z)``."""
        ...

    def base_jacobian(
        self, latent: Float[np.ndarray, "b d"]
    ) -> tuple[Float[np.ndarray, "b d"], Float[np.ndarray, "b d d"]]:
        """``z0`` and ``dz0/dz``."""
        ...

    def from_base(self, base: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
        """``z = g^-1(z0)``."""
        ...


@runtime_checkable
class Completer(Protocol):
    """A network that completes a drawing on a lattice of the canonical frame."""

    lattice: CanonicalLattice

    def logits(self, drawn: Bool[np.ndarray, "2 i j k"]) -> Float[np.ndarray, "i j k"]:
        """Occupancy logits of all voxels from those drawn inside (first) and outside (second)."""
        ...


class OnnxDecoder:
    """A bundle's decoder on ONNX Runtime: single-threaded graphs over pieces of the points, `threads` at a time."""

    def __init__(self, folder: Path, latent_size: int, threads: int | None) -> None:
        self.latent_size = latent_size
        self._workers = Workers(threads or os.cpu_count() or 1)
        jacobians = _session(folder / "decoder_jacobians.onnx", 1)
        self._logits = _network(_session(folder / "decoder_logits.onnx", 1))
        self._jacobians = _network(jacobians)
        self._gradients = _network(jacobians, ("logits", "by_point"))

    def logits(self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n"]:
        """See `Decoder`."""
        return self._workers.evaluate(self._logits, latent, points)[0]

    def logits_and_jacobians(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n d"], Float[np.ndarray, "b n 3"]]:
        """See `Decoder`."""
        logits, by_latent, by_point = self._workers.evaluate(self._jacobians, latent, points)
        return logits, by_latent, by_point

    def logits_and_gradients(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n 3"]]:
        """See `Decoder`."""
        logits, by_point = self._workers.evaluate(self._gradients, latent, points)
        return logits, by_point


class OnnxPrior:
    """A bundle's prior on ONNX Runtime."""

    def __init__(self, folder: Path, latent_size: int, threads: int | None) -> None:
        self.latent_size = latent_size
        self._density = _session(folder / "prior_density.onnx", threads)
        self._jacobian = _session(folder / "prior_base_jacobian.onnx", threads)
        self._steps = [_session(path, threads) for path in _numbered(folder, ".onnx")]

    def log_density(self, latent: Float[np.ndarray, "b d"]) -> tuple[Float[np.ndarray, "b"], Float[np.ndarray, "b d"]]:
        """See `Prior`."""
        density, gradient, _ = _run(self._density, latent=latent)
        return density, gradient

    def to_base(self, latent: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
        """See `Prior`."""
        return _run(self._density, latent=latent)[2]

    def base_jacobian(
        self, latent: Float[np.ndarray, "b d"]
    ) -> tuple[Float[np.ndarray, "b d"], Float[np.ndarray, "b d d"]]:
        """See `Prior`."""
        base, jacobian = _run(self._jacobian, latent=latent)
        return base, jacobian

    def from_base(self, base: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
        """See `Prior`."""
        value = base
        for step in reversed(self._steps):
            value = _fixed_point(step, value)
        return value


class OnnxCompleter:
    """A bundle's completion network on ONNX Runtime."""

    def __init__(self, graph: Path, lattice: CanonicalLattice, threads: int | None) -> None:
        self.lattice = lattice
        self._session = _session(graph, threads)

    def logits(self, drawn: Bool[np.ndarray, "2 i j k"]) -> Float[np.ndarray, "i j k"]:
        """See `Completer`."""
        return np.asarray(_run(self._session, drawn=drawn[None].astype(np.float32))[0][0])


def load_onnx(folder: Path, latent_size: int, threads: int | None) -> tuple[Decoder, Prior]:
    """Decoder and prior of a bundle on ONNX Runtime (CPU)."""
    return OnnxDecoder(folder, latent_size, threads), OnnxPrior(folder, latent_size, threads)


def load_torchscript(folder: Path, latent_size: int, threads: int | None) -> tuple[Decoder, Prior]:
    """Decoder and prior of a bundle on TorchScript; needs the extra ``torch``."""
    from model.networks import torchscript

    with _opening("One of the files .pt"):
        return torchscript.load(folder, latent_size, threads)


def onnx_completer(graph: Path, lattice: CanonicalLattice, threads: int | None) -> Completer:
    """A completion network on ONNX Runtime (CPU)."""
    return OnnxCompleter(graph, lattice, threads)


def torchscript_completer(graph: Path, lattice: CanonicalLattice, threads: int | None) -> Completer:
    """A completion network on TorchScript; needs the extra ``torch``."""
    from model.networks import torchscript

    with _opening(graph.name):
        return torchscript.load_completer(graph, lattice, threads)


def _fixed_point(step: Any, target: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
    """Repeat an autoregressive inverse step; after as many steps as dimensions it is exact."""
    guess = target
    for _ in range(target.shape[1]):
        following = _run(step, target=target, guess=guess)[0]
        if np.array_equal(following, guess):
            break
        guess = following
    return guess


def _numbered(folder: Path, suffix: str) -> list[Path]:
    numbers = {path: path.stem.rsplit("_", 1)[1] for path in folder.glob(f"prior_sampling_*{suffix}")}
    return sorted((path for path in numbers if numbers[path].isdecimal()), key=lambda path: int(numbers[path]))


def _session(path: Path, threads: int | None) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or os.cpu_count() or 1
    options.inter_op_num_threads = 1
    # Idle workers that spin steal cycles from the arithmetic around the graph.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    with _opening(path.name):
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


@contextmanager
def _opening(graph: str) -> Iterator[None]:
    """What a backend raises over a graph is a fault of the bundle; its errors have no parent in common."""
    try:
        yield
    except (BundleError, ImportError, OSError):
        raise
    except Exception as error:
        raise BundleCorrupt(
            f"{graph} is not a graph that this program can open; export the model anew, or update the program."
        ) from error


def _network(session: onnxruntime.InferenceSession, outputs: Sequence[str] | None = None) -> Network:
    """A decoder's graph as a function of arrays; of its outputs only those named, and no arithmetic for others."""
    options = onnxruntime.RunOptions()
    options.only_execute_path_to_fetches = outputs is not None

    def network(latent: Array, points: Array) -> list[Array]:
        results: list[Array] = session.run(outputs, {"latent": latent, "points": points}, options)
        return results

    return network


def _run(session: onnxruntime.InferenceSession, **feeds: Float[np.ndarray, "..."]) -> list[Float[np.ndarray, "..."]]:
    single = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in feeds.items()}
    results: list[Float[np.ndarray, "..."]] = session.run(None, single)
    return results
