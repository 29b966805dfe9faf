"""A finished run as a bundle: graphs, statistics of the training codes, and a manifest."""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from model.bundle import (
    MANIFEST,
    POPULATION,
    Manifest,
    Population,
    ShapeModel,
    check_names,
    file_digest,
    plain_name,
    write_manifest,
)
from model.errors import InvalidParameter
from model.inference.modes import active_counts
from model.networks.decoder import OccupancyDecoder
from model.networks.export import export_graphs, quiet_exporter, torch_networks
from model.networks.prior import LatentPrior
from training.autodecoder import CHECKPOINT, AutoDecoder, is_ended
from training.clusters import clusters_in
from training.config import TrainingConfig
from training.pruning import PriorParts, Pruned, refitted
from training.runs import read_record
from training.saved import intact, read_state

#: Information of one mm^2 of annotated plane where none was calibrated (1/mm^2).
UNCALIBRATED_PRECISION = 0.1
#: Grid step of the surface (mm) unless the caller asks otherwise.
RESOLUTION_MM = 1.0
#: Name, with a suffix, of the folder in the output in which an export is made.
UNFINISHED = ".unfinished-"
#: Of an export, in words.
STAGES = ("fitting the prior", "writing the graphs", "writing the population")

Watch = Callable[[str], None]


@dataclass(frozen=True)
class Naming:
    """What a caller says of a model beside what its run knows.

    Attributes:
        name: the cohort's when None.
        anatomy: the code that results in DICOM carry (`model.bundle.Manifest.anatomy`).
        resolution_mm: grid step of the surface unless a request names another.

    Raises:
        InvalidParameter: see `model.bundle.check_names`.
    """

    name: str | None = None
    version: str = "1"
    anatomy: Mapping[str, str] = field(default_factory=dict)
    resolution_mm: float = RESOLUTION_MM

    def __post_init__(self) -> None:
        check_names(self.name, self.version)

    def on(self, manifest: Manifest) -> Manifest:
        """The manifest with what is said here."""
        name = plain_name(manifest.name) if self.name is None else self.name
        return replace(
            manifest,
            name=name,
            version=self.version,
            anatomy=dict(self.anatomy),
            resolution_mm=self.resolution_mm,
        )


def export_run(
    run: Path,
    output: Path,
    parts: PriorParts | None = None,
    naming: Naming | None = None,
    watch: Watch = lambda words: None,
) -> Manifest:
    """Write the bundle of a finished run: as it was trained, or with these parts of a prior fitted to its codes.

    What an export that was stopped has left in the folder is removed.

    Args:
        naming: that of the cohort when None.
        watch: told each of the `STAGES` as it begins.

    Raises:
        InvalidParameter: the folder holds no finished run, or the output holds something already.
        ParityError: the exported graphs disagree with the networks.
    """
    if output.exists() and not all(path.name.startswith(UNFINISHED) for path in output.iterdir()):
        raise InvalidParameter("The output folder is not empty; a new or an empty folder is accepted.", part="output")
    watch(STAGES[0])
    found = assembled(run, parts)
    output.mkdir(parents=True, exist_ok=True)
    for left in output.iterdir():
        shutil.rmtree(left)
    with TemporaryDirectory(dir=output, prefix=UNFINISHED) as folder:
        manifest = _written(found, Path(folder), naming or Naming(), watch)
        for name in (*manifest.files, MANIFEST):
            (Path(folder) / name).rename(output / name)
    return manifest


def _written(found: "Assembled", folder: Path, naming: Naming, watch: Watch) -> Manifest:
    watch(STAGES[1])
    with quiet_exporter():
        files = export_graphs(found.decoder, found.prior, folder)
    watch(STAGES[2])
    population = found.population()
    np.savez(folder / POPULATION, **asdict(population))
    digests = {file: file_digest(folder / file) for file in sorted([*files, POPULATION])}
    manifest = naming.on(found.manifest())
    clusters = clusters_in(population.base_codes / np.asarray(manifest.sigmas), len(found.record["train"]))
    manifest = replace(manifest, files=digests, clusters={} if clusters is None else clusters.as_values())
    write_manifest(manifest, folder)
    return manifest


def trial_model(run: Path, parts: PriorParts | None) -> ShapeModel:
    """The same model on torch, uncalibrated and without files, for a look at what it can do.

    Raises:
        InvalidParameter: the folder holds no finished run.
    """
    found = assembled(run, parts)
    decoder, prior = torch_networks(found.decoder, found.prior)
    return ShapeModel(found.manifest(), "", found.population(), decoder, prior)


@dataclass(frozen=True)
class Assembled:
    """Networks of a finished run, as they were trained or with a prior fitted to the codes, and what is known of them.

    Attributes:
        less: what was fitted and left out; None where nothing was.
        codes: of the training shapes, in the networks' coordinates.
    """

    config: TrainingConfig
    record: Mapping[str, Any]
    decoder: OccupancyDecoder
    prior: LatentPrior
    codes: Float[torch.Tensor, "m d"]
    less: Pruned | None

    def manifest(self) -> Manifest:
        """Its manifest, uncalibrated and without files."""
        record, half = self.record, self.record["half_extent_mm"]
        sigmas = self.prior.sigma.detach().cpu().numpy().astype(float)
        pruned = {} if self.less is None else {"pruned": self.less.facts()}
        return Manifest(
            name=record["cohort"],
            version="1",
            structure=record["cohort"],
            frame="RAS",
            units="mm",
            side=record["side"],
            latent_size=len(sigmas),
            sigmas=tuple(sigmas.tolist()),
            active_dimensions=active_dimensions(sigmas),
            half_extent_mm=(half[0], half[1], half[2]),
            resolution_mm=RESOLUTION_MM,
            likelihood_precision=UNCALIBRATED_PRECISION,
            calibration={},
            training={**training_facts(self.config, record), **pruned},
            licence=record["licence"],
            attribution=record["attribution"],
            accuracy={},
            files={},
            training_masks=tuple(sorted(record.get("voxel_digests", ()))),
        )

    def population(self) -> Population:
        """Codes, base codes, log densities (nats) and volumes (mL) of the training shapes."""
        with torch.no_grad():
            base, _ = self.prior.to_base(self.codes)
            density = self.prior.log_density(self.codes)
        volumes = np.array(self.record["volumes_ml"], float)
        return Population(_array(self.codes), _array(base), _array(density), volumes)


def assembled(run: Path, parts: PriorParts | None) -> Assembled:
    """The networks of a finished run, with these parts of a prior fitted to its codes, or as they were trained.

    Raises:
        InvalidParameter: the folder holds no finished run.
    """
    config, record = read_record(run)
    module = load_module(run, config, record["codes"])
    if parts is None:
        return Assembled(config, record, module.decoder, module.prior, module.code_means(), None)
    less = refitted(module, len(record["train"]), record["half_extent_mm"], parts)
    return Assembled(config, record, less.decoder, less.prior, less.codes, less)


def load_module(run: Path, config: TrainingConfig, shapes: int) -> AutoDecoder:
    """The trained module of a run, on the CPU.

    Raises:
        InvalidParameter: the run has not reached its last step, or its checkpoint is damaged.
    """
    path = run / CHECKPOINT
    state: dict[str, Any] = read_state(path, "cpu") if path.is_file() else {"step": 0}
    with intact(CHECKPOINT):
        ended = is_ended(state, config)
    if not ended:
        raise InvalidParameter(
            f"The run stands at step {state['step']} of {config.steps}; a finished run is accepted, see --resume.",
            part="run",
        )
    module = AutoDecoder(config, shapes)
    with intact(CHECKPOINT):
        module.load_state_dict(state["module"])
    return module.eval()


def wants_prior(run: Path) -> bool:
    """Whether a run's codes are Gaussians that no flow and no ARD was trained along with: export fits both to them.

    Raises:
        InvalidParameter: the folder holds no run.
    """
    config, _ = read_record(run)
    return config.objective.name != "paper" and not (config.prior.use_flow or config.prior.use_ard)


def _array(values: torch.Tensor) -> Float[np.ndarray, "..."]:
    return np.asarray(values.detach().cpu().numpy(), float)


def active_dimensions(sigmas: Float[np.ndarray, "d"]) -> tuple[int, int, int]:
    """How many dimensions, largest first, hold 95, 97 and 99 % of the base variance."""
    return active_counts(np.cumsum(np.sort(sigmas**2)[::-1]) / np.sum(sigmas**2))


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
