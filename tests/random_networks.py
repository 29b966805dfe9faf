"""Small networks with random weights, far from the identity, and the bundle made of them."""

import hashlib
import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from model.bundle import POPULATION, Manifest, write_manifest
from model.networks.decoder import DecoderShape, OccupancyDecoder
from model.networks.export import export_graphs
from model.networks.flow import FlowShape
from model.networks.prior import LatentPrior, PriorShape

DECODER = DecoderShape(latent_size=3, width=16, depth=3, extent_mm=20.0)
PRIOR = PriorShape(FlowShape(latent_size=3, transforms=2, bins=3, width=8))


def randomise(module: nn.Module, seed: int, spread: float) -> None:
    """Normal weights."""
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(spread * torch.randn(parameter.shape, generator=random))


def random_decoder(shape: DecoderShape = DECODER, seed: int = 0) -> OccupancyDecoder:
    """A decoder whose output varies over its cube."""
    torch.manual_seed(seed)
    decoder = OccupancyDecoder(shape)
    with torch.no_grad():
        for layer in decoder.hidden:
            layer.bias.normal_(std=0.3)
    return decoder


def random_prior(shape: PriorShape = PRIOR, seed: int = 0) -> LatentPrior:
    """A prior with a bent flow and unequal sigmas."""
    prior = LatentPrior(shape)
    randomise(prior.flow, seed, 0.4)
    with torch.no_grad():
        prior.log_sigma.copy_(torch.linspace(-0.7, 0.3, shape.flow.latent_size))
    return prior


@dataclass(frozen=True)
class Exported:
    """A bundle and the networks it was made of."""

    decoder: OccupancyDecoder
    prior: LatentPrior
    folder: Path


def export_random(folder: Path) -> Exported:
    """Write the random networks as a bundle."""
    decoder, prior = random_decoder(), random_prior()
    with warnings.catch_warnings(), _without_logs():
        warnings.simplefilter("ignore")
        files = export_graphs(decoder, prior, folder)
    codes = np.random.default_rng(0).normal(size=(5, 3))
    np.savez(folder / POPULATION, codes=codes, base_codes=2 * codes, log_densities=codes[:, 0], volumes_ml=codes[:, 1])
    write_manifest(manifest_of(folder, [*files, POPULATION]), folder)
    return Exported(decoder, prior, folder)


@contextmanager
def _without_logs() -> Iterator[None]:
    """The exporter's trace records are many, and a handler that keeps them all doubles its time."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def jacobian(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """(b, d, d) derivatives of a function of rows, by one backward pass a dimension."""
    at = x.detach().requires_grad_(True)
    y = function(at)
    rows = [torch.autograd.grad(y[:, i].sum(), at, retain_graph=True)[0] for i in range(y.shape[1])]
    return torch.stack(rows, dim=1)


def manifest_of(folder: Path, files: list[str]) -> Manifest:
    """A manifest that vouches for the files."""
    return Manifest(
        name="random",
        version="1",
        structure="noise",
        frame="RAS",
        units="mm",
        side="unpaired",
        latent_size=3,
        sigmas=(1.0, 0.5, 0.25),
        active_dimensions=(2, 3, 3),
        half_extent_mm=(20.0, 19.0, 18.0),
        resolution_mm=1.0,
        likelihood_precision=0.1,
        calibration={},
        training={"cohort": "none", "cases": [1, 2], "config": {"steps": 0}},
        licence="CC0-1.0",
        attribution="nobody",
        accuracy={"thin": {"dice": 0.5}},
        files={name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in files},
    )
