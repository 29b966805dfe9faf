"""A finished run as a bundle: graphs, statistics of the training codes, and a manifest."""

import hashlib
import logging
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from model.bundle import POPULATION, Manifest, write_manifest
from model.errors import InvalidParameter
from model.networks.export import export_graphs
from model.networks.prior import LatentPrior
from training.autodecoder import AutoDecoder, is_ended
from training.config import TrainingConfig
from training.pruning import PriorParts, refitted
from training.runs import CHECKPOINT, read_record

#: Shares of the base variance for which active dimensions are counted (MorphoFlow paper).
VARIANCE_SHARES = (0.95, 0.97, 0.99)
#: Information of one mm^2 of annotated plane where none was calibrated (1/mm^2).
UNCALIBRATED_PRECISION = 0.1
#: Grid step of the surface (mm) unless the caller asks otherwise.
RESOLUTION_MM = 1.0


def export_run(
    run: Path,
    output: Path,
    *,
    name: str | None = None,
    version: str = "1",
    likelihood_precision: float = UNCALIBRATED_PRECISION,
    accuracy: Mapping[str, Mapping[str, float]] | None = None,
    parts: PriorParts | None = None,
    anatomy: Mapping[str, str] | None = None,
    resolution_mm: float = RESOLUTION_MM,
) -> Manifest:
    """Write the bundle of a finished run: as it was trained, or with these parts of a prior fitted to its codes.

    `anatomy` is the code that results in DICOM carry (`model.bundle.Manifest.anatomy`).

    Raises:
        InvalidParameter: the folder holds no finished run, or the output holds something already.
        ParityError: the exported graphs disagree with the networks.
    """
    config, record = read_record(run)
    module = load_module(run, config, record["codes"])
    if output.exists() and any(output.iterdir()):
        raise InvalidParameter("The output folder is not empty; a new or an empty folder is accepted.", part="output")
    output.mkdir(parents=True, exist_ok=True)
    less = None if parts is None else refitted(module, len(record["train"]), record["half_extent_mm"], parts)
    decoder, prior = (module.decoder, module.prior) if less is None else (less.decoder, less.prior)
    with _quiet_exporter():
        files = export_graphs(decoder, prior, output)
    write_population(prior, module.code_means() if less is None else less.codes, record, output / POPULATION)
    sigmas = prior.sigma.detach().cpu().numpy().astype(float)
    manifest = Manifest(
        name=name or record["cohort"],
        version=version,
        structure=record["cohort"],
        frame="RAS",
        units="mm",
        side=record["side"],
        latent_size=len(sigmas),
        sigmas=tuple(sigmas.tolist()),
        active_dimensions=active_dimensions(sigmas),
        half_extent_mm=(record["half_extent_mm"][0], record["half_extent_mm"][1], record["half_extent_mm"][2]),
        resolution_mm=resolution_mm,
        likelihood_precision=likelihood_precision,
        calibration={},
        training={**training_facts(config, record), **({} if less is None else {"pruned": less.facts()})},
        licence=record["licence"],
        attribution=record["attribution"],
        accuracy={regime: dict(figures) for regime, figures in (accuracy or {}).items()},
        anatomy=dict(anatomy or {}),
        files={file: _digest(output / file) for file in sorted([*files, POPULATION])},
    )
    write_manifest(manifest, output)
    return manifest


@contextmanager
def _quiet_exporter() -> Iterator[None]:
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


def load_module(run: Path, config: TrainingConfig, shapes: int) -> AutoDecoder:
    """The trained module of a run, on the CPU.

    Raises:
        InvalidParameter: the run has not reached its last step.
    """
    path = run / CHECKPOINT
    state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True) if path.is_file() else {"step": 0}
    if not is_ended(state, config):
        raise InvalidParameter(
            f"The run stands at step {state['step']} of {config.steps}; a finished run is accepted, see --resume.",
            part="run",
        )
    module = AutoDecoder(config, shapes)
    module.load_state_dict(state["module"])
    return module.eval()


def wants_prior(run: Path) -> bool:
    """Whether a run's codes are Gaussians that no flow and no ARD was trained along with: export fits both to them.

    Raises:
        InvalidParameter: the folder holds no run.
    """
    config, _ = read_record(run)
    return config.objective.name != "paper" and not (config.prior.use_flow or config.prior.use_ard)


def write_population(
    prior: LatentPrior, codes: Float[torch.Tensor, "m d"], record: Mapping[str, Any], path: Path
) -> None:
    """Codes, base codes, log densities (nats) and volumes (mL) of the training shapes."""
    with torch.no_grad():
        base, _ = prior.to_base(codes)
        density = prior.log_density(codes)
    np.savez(
        path,
        codes=_array(codes),
        base_codes=_array(base),
        log_densities=_array(density),
        volumes_ml=np.array(record["volumes_ml"], float),
    )


def _array(values: torch.Tensor) -> Float[np.ndarray, "..."]:
    return np.asarray(values.detach().cpu().numpy(), float)


def active_dimensions(sigmas: Float[np.ndarray, "d"]) -> tuple[int, int, int]:
    """How many dimensions, largest first, hold 95, 97 and 99 % of the base variance."""
    shares = np.cumsum(np.sort(sigmas**2)[::-1]) / np.sum(sigmas**2)
    counts = [int(np.searchsorted(shares, share - 1e-12)) + 1 for share in VARIANCE_SHARES]
    return counts[0], counts[1], counts[2]


def training_facts(config: TrainingConfig, record: Mapping[str, Any]) -> dict[str, object]:
    """What a user of the bundle wants to know of its training."""
    return {
        "cohort": record["cohort"],
        "source": record["source"],
        "shapes": len(record["train"]),
        "weights_may_ship": record["shippable"],
        "refused": record["refused"],
        "config": config.as_dict(),
    }


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
