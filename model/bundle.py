"""The exported artefact: a folder with a manifest, network graphs and statistics of the training codes."""

import hashlib
import json
import re
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from model.backends import (
    Completer,
    Decoder,
    Prior,
    load_onnx,
    load_torchscript,
    onnx_completer,
    torchscript_completer,
)
from model.errors import BundleCorrupt, BundleIncomplete, BundleTooNew, InvalidParameter
from model.geometry import CanonicalLattice
from model.manifest_values import check_values

BackendName = Literal["onnx", "torchscript"]
#: Format of the bundles that this program writes, and the newest that it reads.
FORMAT = 1
MANIFEST = "manifest.json"
POPULATION = "population.npz"
#: Names and versions of models: they stand in addresses, in names of files, and on either side of an ``@``.
PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]*")
#: What such a name is made of, in words.
PLAIN_WORDS = "letters from A to Z, digits, '.', '_', '+' and '-', with a letter or a digit first"
#: Files without which there is nothing to run.
REQUIRED_FILES = (
    POPULATION,
    "decoder_logits.onnx",
    "decoder_jacobians.onnx",
    "prior_density.onnx",
    "prior_base_jacobian.onnx",
)
#: The graph of a completion network, where a bundle has one.
COMPLETION = "completion"
#: Suffix of each backend's graphs.
SUFFIXES: dict[BackendName, str] = {"onnx": ".onnx", "torchscript": ".pt"}


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
        calibration: how the likelihood precision was chosen; empty when it was not.
        likelihood_precision: information of one mm^2 of annotated plane, 1/mm^2; calibrated on validation shapes.
        discrepancy: ``spread_mm`` and ``fidelity`` of what the code leaves unexplained at contours
            (`model.inference.discrepancy`), chosen on validation shapes; empty when they were not.
        usual: highest figures that answers from sound drawings usually have (`model.inference.reliability`), estimated
            on validation shapes: ``misfit_mm`` and ``surface_sd_mm`` with five planes, ``misfit_exponent`` and
            ``surface_sd_exponent`` in the number of planes; not judged when empty.
        posterior: ``sd_scale``, the factor on posterior SDs of the surface, and ``offset_mm``, the SD of an error that
            the whole surface shares (`model.inference.uncertainty`), estimated on validation shapes, and
            ``vertex_ratio``, that of errors to SDs of vertices, which is told and not used; and ``sharpness``, the
            factor on logits before probabilities are taken of them, 1 when it is not there. SDs and logits are taken as
            they are when empty.
        typical: what real shapes look like to the model (`model.inference.typicality`), from sound drawings of
            validation shapes; judged by the density of training codes alone when empty.
        training: cohort, cases, regime, command and so on.
        licence, attribution: of the weights.
        accuracy: measured figures by regime, for example ``{"thin": {"dice": 0.87, "asd_mm": 0.34}}``.
        files: SHA-256 by file name.
        completion: of a network that completes drawings (`model.inference.completion`): ``voxels`` and ``step_mm`` of
            its lattice, ``share`` of its distances beside those of the fitted surface, chosen on validation shapes,
            and ``training``; empty without one.
        training_masks: digests of the training masks' voxels (`training.seen`), by which no shape of the training is
            taken for a held-out one; empty where they are not known.
        clusters: two kinds of training shapes between which nothing is drawn (`model.inference.clusters`):
            ``direction``, ``shares``, ``means`` and ``sd``; empty where they are of one kind.
        anatomy: code of the structure, by default none: ``value``, ``scheme`` (``SCT`` for SNOMED CT) and ``meaning``.
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
    calibration: dict[str, object]
    training: dict[str, object]
    licence: str
    attribution: str
    accuracy: dict[str, dict[str, float]]
    files: dict[str, str]
    anatomy: dict[str, str] = field(default_factory=dict)
    discrepancy: dict[str, float] = field(default_factory=dict)
    usual: dict[str, float] = field(default_factory=dict)
    posterior: dict[str, float] = field(default_factory=dict)
    typical: dict[str, float] = field(default_factory=dict)
    completion: dict[str, Any] = field(default_factory=dict)
    training_masks: tuple[str, ...] = field(default_factory=tuple)
    clusters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Population:
    """Statistics of the training codes (``population.npz``)."""

    codes: Float[np.ndarray, "m d"]
    base_codes: Float[np.ndarray, "m d"]
    log_densities: Float[np.ndarray, "m"]
    volumes_ml: Float[np.ndarray, "m"]


@dataclass(frozen=True)
class ShapeModel:
    """A bundle opened for inference.

    Attributes:
        digest: SHA-256 over the manifest, which holds all the others.
        completer: completes drawings; None where the bundle has no such network.
    """

    manifest: Manifest
    digest: str
    population: Population
    decoder: Decoder
    prior: Prior
    completer: Completer | None = None


def open_bundle(folder: Path, *, backend: BackendName = "onnx", threads: int | None = None) -> ShapeModel:
    """Open a bundle after checking format, files and hashes.

    Raises:
        BundleIncomplete, BundleCorrupt, BundleTooNew: it cannot be trusted; the sentence says why.
    """
    manifest, digest = read_manifest(folder)
    _check_listed(folder, manifest, SUFFIXES[backend])
    for name, expected in manifest.files.items():
        _check_file(folder / name, expected)
    load = {"onnx": load_onnx, "torchscript": load_torchscript}[backend]
    decoder, prior = load(folder, manifest.latent_size, threads)
    completer = _completer(folder, manifest, backend, threads)
    population = _read_population(folder / POPULATION, manifest.latent_size)
    return ShapeModel(manifest, digest, population, decoder, prior, completer)


def _completer(folder: Path, manifest: Manifest, backend: BackendName, threads: int | None) -> Completer | None:
    """The completion network of a bundle, where it has one."""
    known = manifest.completion
    if not known:
        return None
    graph = folder / f"{COMPLETION}{SUFFIXES[backend]}"
    if graph.name not in manifest.files:
        raise BundleIncomplete(f"{MANIFEST} lists no {graph.name}; one written by morphoflow complete is accepted.")
    try:
        i, j, k = map(int, known["voxels"])
        lattice = CanonicalLattice((i, j, k), float(known["step_mm"]))
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise BundleCorrupt(
            f"{MANIFEST} does not say on which lattice its network completes drawings; one written by morphoflow "
            "complete is accepted."
        ) from error
    return {"onnx": onnx_completer, "torchscript": torchscript_completer}[backend](graph, lattice, threads)


def read_manifest(folder: Path) -> tuple[Manifest, str]:
    """Manifest and its SHA-256, without opening the graphs.

    Raises:
        BundleIncomplete, BundleCorrupt, BundleTooNew: see `open_bundle`.
    """
    path = folder / MANIFEST
    if not path.is_file():
        raise BundleIncomplete(f"The bundle has no {MANIFEST}; a folder written by morphoflow export is accepted.")
    data = path.read_bytes()
    try:
        values = json.loads(data)
        written = int(values.pop("format"))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise BundleCorrupt(f"{MANIFEST} cannot be parsed; one written by morphoflow export is accepted.") from error
    if written > FORMAT:
        raise BundleTooNew(f"The bundle has format {written}; this program reads formats up to {FORMAT}.")
    return _manifest_of(values), hashlib.sha256(data).hexdigest()


def check_names(name: str | None, version: str) -> None:
    """Refuse names and versions of models that no address could hold.

    Raises:
        InvalidParameter: says of which letters they may be.
    """
    for part, text in (("name", name), ("version", version)):
        if text is not None and not PLAIN_NAME.fullmatch(text):
            raise InvalidParameter(f"The {part} of a model must be of {PLAIN_WORDS}.", part=part)


def plain_name(text: str) -> str:
    """A model's name that is like a text: small letters, and hyphens in place of what a name cannot hold."""
    return re.sub(r"[^a-z0-9._-]+", "-", text.lower()).strip("._-") or "model"


def write_manifest(manifest: Manifest, folder: Path) -> None:
    """Write ``manifest.json``; inverse of `read_manifest`.

    Raises:
        InvalidParameter: see `check_names`.
    """
    check_names(manifest.name, manifest.version)
    values = {"format": FORMAT, **{f.name: getattr(manifest, f.name) for f in fields(Manifest)}}
    (folder / MANIFEST).write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def _manifest_of(values: dict[str, Any]) -> Manifest:
    known = {f.name for f in fields(Manifest)}
    needed = {f.name for f in fields(Manifest) if f.default_factory is MISSING}
    missing = sorted(needed - values.keys())
    if missing:
        raise BundleCorrupt(f"{MANIFEST} lacks {', '.join(missing)}; one written by morphoflow export is accepted.")
    values = {name: tuple(v) if isinstance(v, list) else v for name, v in values.items() if name in known}
    if not all(isinstance(values[part], str) and PLAIN_NAME.fullmatch(values[part]) for part in ("name", "version")):
        raise BundleCorrupt(f"{MANIFEST} has a name or a version that is not of {PLAIN_WORDS}; export the model anew.")
    files = values["files"]
    if not isinstance(files, dict) or not all(_is_plain(name) for name in files):
        raise BundleCorrupt(f"{MANIFEST} lists files outside the bundle; names of files beside it are accepted.")
    unlisted = [name for name in REQUIRED_FILES if name not in files]
    if unlisted:
        raise BundleIncomplete(f"{MANIFEST} lists no {', '.join(unlisted)}; export the model anew.")
    check_values(values)
    return Manifest(**values)


def _is_plain(name: str) -> bool:
    """Whether a file of this name lies in the bundle's folder itself, on any system."""
    return name not in ("", ".", "..") and not set(name) & set("/\\:\0")


def _check_listed(folder: Path, manifest: Manifest, suffix: str) -> None:
    """Every graph that would be loaded stands in the manifest: none was slipped in beside those it vouches for."""
    loaded = {f"{graph}{suffix}" for graph in ("decoder_logits", "decoder_jacobians", "prior_density")}
    loaded |= {path.name for path in folder.glob(f"*{suffix}")}
    unlisted = sorted(loaded - manifest.files.keys())
    if unlisted:
        raise BundleCorrupt(f"{MANIFEST} does not list {', '.join(unlisted)}; export or copy the bundle anew.")


def file_digest(path: Path) -> str:
    """SHA-256 of a bundle's file, as the manifest holds it."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _check_file(path: Path, expected: str) -> None:
    if not path.is_file():
        raise BundleIncomplete(f"The bundle lacks {path.name}, which its manifest lists.")
    if file_digest(path) != expected:
        raise BundleCorrupt(f"{path.name} differs from the SHA-256 in the manifest; export or copy the bundle anew.")


def _read_population(path: Path, latent_size: int) -> Population:
    stored = _arrays(path)
    missing = [f.name for f in fields(Population) if f.name not in stored]
    if missing:
        raise BundleCorrupt(f"{path.name} lacks {', '.join(missing)}; export the model anew.")
    codes = stored["codes"]
    if codes.shape[1:] != (latent_size,) or stored["base_codes"].shape != codes.shape:
        raise BundleCorrupt(f"{path.name} holds codes of another size than the manifest's latent_size {latent_size}.")
    for name in ("log_densities", "volumes_ml"):
        if stored[name].shape != codes.shape[:1]:
            raise BundleCorrupt(f"{path.name} must hold as many {name} as codes; export the model anew.")
    population = {f.name: stored[f.name] for f in fields(Population)}
    if not all(np.issubdtype(values.dtype, np.floating) for values in population.values()):
        raise BundleCorrupt(f"{path.name} must hold floating-point numbers alone; export the model anew.")
    return Population(**population)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a file by name."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return dict(stored)
    except OSError:
        raise
    except Exception as error:  # whatever else it is, it comes from what the file holds
        raise BundleCorrupt(f"{path.name} cannot be parsed; export the model anew.") from error
