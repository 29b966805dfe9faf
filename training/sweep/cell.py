"""One cell: train, export, calibrate, measure on test shapes, generate; what is there is skipped."""

import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.bundle import Manifest, ShapeModel, open_bundle, read_manifest
from model.errors import InvalidParameter
from training.calibration import calibrate_bundle
from training.choices import (
    DeviceName,
    ObjectiveName,
    RegimeName,
    configured,
    with_batches,
    with_duration,
    with_patience,
)
from training.cohorts.cohort import Cohort
from training.config import Regime, TrainingConfig
from training.evaluate import Method, fills_of, measure
from training.generation import SAMPLES, generated
from training.release import active_dimensions, export_run
from training.runs import CHECKPOINT, train_cohort
from training.sparsify import for_evaluation
from training.sweep.plan import Cell
from training.sweep.priors import PriorName
from training.sweep.table import FIGURES, Result

RUN, BUNDLE = "run", "bundle"

#: Told what is done and how much of it: words, done, total.
Watch = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Effort:
    """How much work each cell may be.

    Attributes:
        steps: of training; those of the default configuration when None.
        patience: see `TrainingConfig.patience`.
        calibrate: whether precision and discrepancy are chosen on validation shapes.
        samples: generated shapes.
        cases: test shapes that are measured; all when None.
        reflect: whether mirror images join; as `morphoflow train` does it when None.
    """

    steps: int | None = None
    patience: int = 0
    calibrate: bool = True
    samples: int = SAMPLES
    cases: int | None = None
    reflect: bool | None = None


def run_cell(
    cell: Cell,
    cohort: Cohort,
    folder: Path,
    effort: Effort,
    device: DeviceName,
    *,
    known: bool,
    watch: Watch = lambda words, done, total: None,
) -> Result:
    """Bring a cell to its result, from wherever an earlier attempt left it.

    Args:
        folder: of the cell; the run, its checkpoint and the bundle lie in it.
        known: whether the cohort is a public one, see `training.choices`.
    """
    begin = time.perf_counter()
    bundle = folder / BUNDLE
    if not (bundle / "manifest.json").is_file():
        config = config_of(cell, cohort, effort, device, known=known)
        _train(cohort, config, folder / RUN, watch)
        _export(folder / RUN, bundle, cohort, effort, prune=cell.prior is not PriorName.PLAIN)
    model = open_bundle(bundle, threads=1)
    return result_of(cell, model, cohort, effort, time.perf_counter() - begin, watch)


def config_of(cell: Cell, cohort: Cohort, effort: Effort, device: DeviceName, *, known: bool) -> TrainingConfig:
    """The configuration of a cell's training."""
    objective = ObjectiveName(cell.objective)
    paired = effort.reflect
    if paired is None:
        paired = known and cohort.reflects and objective is not ObjectiveName.PAPER
    config = configured(
        objective,
        RegimeName(cell.regime),
        cell.latent_size,
        flow=cell.prior.flow,
        ard=cell.prior.ard,
        reflected=paired,
        seed=cell.seed,
        device=device,
    )
    codes = (2 if paired else 1) * len(cohort.train)
    return with_patience(with_duration(with_batches(config, codes), effort.steps, None, codes), effort.patience)


def result_of(cell: Cell, model: ShapeModel, cohort: Cohort, effort: Effort, seconds: float, watch: Watch) -> Result:
    """Measure an exported cell.

    Raises:
        InvalidParameter: the cohort has no test shapes.
    """
    if not cohort.test:
        raise InvalidParameter(
            "The cohort has no test shapes; one with a test split, or --test-fraction, is accepted.", part="cohort"
        )
    trained = trained_sigmas(model.manifest)
    drawn = generated(model, samples=effort.samples, watch=lambda number: watch("generating", number, effort.samples))
    return Result(
        key=cell.key,
        regime=cell.regime,
        latent_size=cell.latent_size,
        prior=cell.prior.value,
        seed=cell.seed,
        objective=cell.objective,
        cohort=cohort.name,
        source=cohort.source,
        licence=cohort.licence,
        shippable=cohort.provenance.shippable,
        shapes=len(cohort.train),
        steps=steps_of(model.manifest),
        seconds=round(seconds, 1),
        sigmas=sorted(trained, reverse=True),
        active=list(active_dimensions(np.array(trained))),
        latent=drawn.latent.round(4).tolist(),
        surface_mm=drawn.surface_mm.round(4).tolist(),
        measured={regime: _measured(model, cohort, regime, effort, watch) for regime in cell.measured_in},
    )


def steps_of(manifest: Manifest) -> int:
    """Steps that the configuration in a manifest asks for."""
    config = manifest.training["config"]
    return int(config["steps"]) if isinstance(config, dict) else 0


def trained_sigmas(manifest: Manifest) -> list[float]:
    """Sigmas of all dimensions that were trained, dead ones among them."""
    pruned = manifest.training.get("pruned")
    known = pruned.get("trained_sigmas") if isinstance(pruned, Mapping) else None
    return list(manifest.sigmas if known is None else known)


def adopt(bundle: Path, folder: Path) -> None:
    """Take an exported bundle as a cell's own."""
    read_manifest(bundle)
    if not (folder / BUNDLE).exists():
        shutil.copytree(bundle, folder / BUNDLE)


def _train(cohort: Cohort, config: TrainingConfig, run: Path, watch: Watch) -> None:
    resume = (run / CHECKPOINT).is_file()
    if run.exists() and not resume:
        shutil.rmtree(run)
    train_cohort(cohort, config, run, resume=resume, watch=lambda step, figures: watch("training", step, config.steps))


def _export(run: Path, bundle: Path, cohort: Cohort, effort: Effort, *, prune: bool) -> None:
    part = bundle.with_name(f"{bundle.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    export_run(run, part, prune=prune)
    if effort.calibrate and cohort.validation:
        calibrate_bundle(part, cohort, threads=1)
    part.rename(bundle)


def _measured(
    model: ShapeModel, cohort: Cohort, regime: Regime, effort: Effort, watch: Watch
) -> dict[str, dict[str, float] | None]:
    fill = fills_of(model, 0)[Method.MODEL]
    cases = cohort.test[: effort.cases]
    found: dict[str, dict[str, float] | None] = {}
    for number, case in enumerate(cases):
        drawing = for_evaluation(case.mask, case.grid, regime)
        agreement = measure(case, regime, drawing, Method.MODEL, fill).agreement
        found[case.name] = None if agreement is None else {name: getattr(agreement, name) for name in FIGURES}
        watch(f"measuring {regime}", number + 1, len(cases))
    return found
