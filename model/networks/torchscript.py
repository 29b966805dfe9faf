"""Networks on torch: from TorchScript, the second implementation behind `model.backends`, or from modules."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from model.geometry import CanonicalLattice

#: A graph as `model.networks.export` names it.
Graph = Callable[..., Any]


class TorchDecoder:
    """A decoder by its graphs; see `model.backends.Decoder`."""

    def __init__(self, latent_size: int, logits: Graph, jacobians: Graph) -> None:
        self.latent_size = latent_size
        self._logits, self._jacobians = logits, jacobians

    def logits(self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n"]:
        """See `model.backends.Decoder`."""
        with torch.no_grad():
            return _array(self._logits(_tensor(latent), _tensor(points)))

    def logits_and_jacobians(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n d"], Float[np.ndarray, "b n 3"]]:
        """See `model.backends.Decoder`."""
        with torch.no_grad():
            logits, by_latent, by_point = self._jacobians(_tensor(latent), _tensor(points))
        return _array(logits), _array(by_latent), _array(by_point)

    def logits_and_gradients(
        self, latent: Float[np.ndarray, "b d"], points: Float[np.ndarray, "b n 3"]
    ) -> tuple[Float[np.ndarray, "b n"], Float[np.ndarray, "b n 3"]]:
        """See `model.backends.Decoder`."""
        logits, _, by_point = self.logits_and_jacobians(latent, points)
        return logits, by_point


class TorchPrior:
    """A prior by its graphs; see `model.backends.Prior`."""

    def __init__(self, latent_size: int, density: Graph, steps: Sequence[Graph]) -> None:
        self.latent_size = latent_size
        self._density, self._steps = density, steps

    def log_density(self, latent: Float[np.ndarray, "b d"]) -> tuple[Float[np.ndarray, "b"], Float[np.ndarray, "b d"]]:
        """See `model.backends.Prior`."""
        code = _tensor(latent).requires_grad_(True)
        density, _ = self._density(code)
        (gradient,) = torch.autograd.grad(density.sum(), code)
        return _array(density), _array(gradient)

    def to_base(self, latent: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
        """See `model.backends.Prior`."""
        with torch.no_grad():
            return _array(self._density(_tensor(latent))[1])

    def base_jacobian(
        self, latent: Float[np.ndarray, "b d"]
    ) -> tuple[Float[np.ndarray, "b d"], Float[np.ndarray, "b d d"]]:
        """See `model.backends.Prior`; every row of the Jacobian from its own copy of the code."""
        copies = _tensor(np.repeat(latent, self.latent_size, axis=0)).requires_grad_(True)
        base = self._density(copies)[1].unflatten(0, (-1, self.latent_size))
        (jacobian,) = torch.autograd.grad(base.diagonal(dim1=1, dim2=2).sum(), copies)
        return _array(base[:, 0]), _array(jacobian.unflatten(0, (-1, self.latent_size)))

    def from_base(self, base: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b d"]:
        """See `model.backends.Prior`."""
        value = _tensor(base)
        with torch.no_grad():
            for step in reversed(self._steps):
                guess = value
                for _ in range(value.shape[1]):
                    guess = step(value, guess)
                value = guess
        return _array(value)


class TorchCompleter:
    """A completion network by its graph; see `model.backends.Completer`."""

    def __init__(self, graph: Graph, lattice: CanonicalLattice) -> None:
        self.lattice = lattice
        self._graph = graph

    def logits(self, drawn: Bool[np.ndarray, "2 i j k"]) -> Float[np.ndarray, "i j k"]:
        """See `model.backends.Completer`."""
        with torch.no_grad():
            return _array(self._graph(_tensor(drawn[None]))[0])


def load(folder: Path, latent_size: int, threads: int | None) -> tuple[TorchDecoder, TorchPrior]:
    """Decoder and prior of a bundle."""
    if threads:
        torch.set_num_threads(threads)
    logits, jacobians, density = (
        torch.jit.load(folder / f"{name}.pt") for name in ("decoder_logits", "decoder_jacobians", "prior_density")
    )
    count = len(list(folder.glob("prior_sampling_*.pt")))
    steps = [torch.jit.load(folder / f"prior_sampling_{k}.pt") for k in range(count)]
    return TorchDecoder(latent_size, logits, jacobians), TorchPrior(latent_size, density, steps)


def load_completer(graph: Path, lattice: CanonicalLattice, threads: int | None) -> TorchCompleter:
    """Completion network of a bundle."""
    if threads:
        torch.set_num_threads(threads)
    return TorchCompleter(torch.jit.load(graph), lattice)


def _tensor(values: Float[np.ndarray, "..."] | Bool[np.ndarray, "..."]) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float32, order="C"))


def _array(values: Tensor) -> Float[np.ndarray, "..."]:
    return np.asarray(values.detach().numpy())
