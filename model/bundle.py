"""The exported artefact: a folder with a manifest, network graphs and statistics of the training codes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from model.backends import Decoder, Prior

BackendName = Literal["onnx", "torchscript"]


@dataclass(frozen=True)
class Manifest:
    """What a bundle says about itself (``manifest.json``).

    Attributes:
        name, version: of the model.
        structure: the anatomy in words, for example ``hippocampus``.
        frame, units: of the canonical frame, always ``RAS`` and ``mm``.
        side: side convention: ``left``, ``right``, ``mixed`` or ``unpaired``.
        latent_size: dimensions of the latent code.
        sigmas: (d,) standard deviations of the flow's base, one a dimension.
        active_dimensions: how many sigmas explain 95, 97 and 99 % of the base variance.
        half_extent_mm: half size of the canonical box that holds every training shape.
        resolution_mm: default grid step of the surface.
        likelihood_precision: information of one mm^2 of annotated plane, 1/mm^2; calibrated on validation shapes.
        training: cohort, cases, regime, command and so on.
        licence, attribution: of the weights.
        accuracy: measured figures by regime, for example ``{"thin": {"dice": 0.87, "asd_mm": 0.34}}``.
        files: SHA-256 by file name.
    """

    name: str
    version: str
    structure: str
    frame: str
    units: str
    side: str
    latent_size: int
    sigmas: tuple[float, ...]
    active_dimensions: tuple[int, int, int]
    half_extent_mm: tuple[float, float, float]
    resolution_mm: float
    likelihood_precision: float
    training: dict[str, object]
    licence: str
    attribution: str
    accuracy: dict[str, dict[str, float]]
    files: dict[str, str]


@dataclass(frozen=True)
class Population:
    """Statistics of the training codes (``population.npz``)."""

    codes: Float[np.ndarray, "m d"]
    base_codes: Float[np.ndarray, "m d"]
    log_densities: Float[np.ndarray, "m"]
    volumes_ml: Float[np.ndarray, "m"]


@dataclass(frozen=True)
class ShapeModel:
    """A bundle opened for inference. `digest` is the SHA-256 over the manifest, which holds all the others."""

    manifest: Manifest
    digest: str
    population: Population
    decoder: Decoder
    prior: Prior


def open_bundle(folder: Path, *, backend: BackendName = "onnx", threads: int | None = None) -> ShapeModel:
    """Open a bundle after checking format, files and hashes.

    Raises:
        BundleIncomplete, BundleCorrupt, BundleTooNew: it cannot be trusted; the sentence says why.
    """
    raise NotImplementedError
