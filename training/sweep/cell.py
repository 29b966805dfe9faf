"""One cell: train, export, calibrate, measure on test shapes, generate; what is there is skipped."""

import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from model.bundle import MANIFEST, Manifest, ShapeModel, open_bundle, read_manifest
from model.errors import InvalidParameter
from training.autodecoder import CHECKPOINT
from training.calibration import PRECISIONS, calibrate_bundle, calibrate_bundle_as
from training.choices import DeviceName, ObjectiveName, RegimeName, TrainingChoice
from training.cohorts.cohort import Case, Cohort
from training.config import Regime, TrainingConfig
from training.configuring import configured_for
from training.evaluate import Method, fills_of, given_bundle, measure
from training.generation import SAMPLES, generated
from training.prior_choice import FITTED, chosen_parts
from training.pruning import PriorParts
from training.release import UNCALIBRATED_PRECISION, active_dimensions, export_run
from training.report import FIGURES
from training.runs import Run, is_finished, prepare
from training.seen import check_unseen
from training.sparsify import for_evaluation
from training.sweep.plan import Cell, cell_of
from training.sweep.priors import PriorName
from training.sweep.table import Result

#: Folders of a sweep.
TRAININGS, CELLS = "trainings", "cells"

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

    def settings(self) -> dict[str, object]:
        """What a user chose of it, under the names of the options."""
        return {
            "steps": TrainingConfig().steps if self.steps is None else self.steps,
            "limit": "all" if self.cases is None else self.cases,
            "samples": self.samples,
            "patience": self.patience,
            "calibrate": self.calibrate,
        }


@dataclass(frozen=True)
class Place:
    """Where the parts of a cell lie.

    Attributes:
        run: its training's, which other cells may share.
        bundle: its own.
        plain: the bundle of the cell of that training that keeps the prior as it was trained; itself, of such a cell.
    """

    run: Path
    bundle: Path
    plain: Path

    @classmethod
    def of(cls, sweep_folder: Path, cell: Cell) -> "Place":
        """Of a cell in a sweep's folder."""
        plain = cell if cell.together else replace(cell, prior=PriorName.PLAIN)
        cells = sweep_folder / CELLS
        run = sweep_folder / TRAININGS / cell.training_key / "run"
        return cls(run, cells / cell.key / "bundle", cells / plain.key / "bundle")

    @property
    def is_exported(self) -> bool:
        """Whether the bundle is there."""
        return is_exported(self.bundle)


def is_exported(bundle: Path) -> bool:
    """Whether a bundle is there."""
    return (bundle / MANIFEST).is_file()


def run_cell(
    cell: Cell,
    cohort: Cohort,
    place: Place,
    effort: Effort,
    device: DeviceName,
    *,
    watch: Watch = lambda words, done, total: None,
) -> Result:
    """Bring a cell to its result, from wherever an earlier attempt left it."""
    begin = time.perf_counter()
    if not place.is_exported:
        config = config_of(cell, cohort, effort, device)
        if not is_finished(place.run, cohort, config):
            prepared(cohort, config, place.run).go(lambda step, _: watch("training", step, config.steps))
        _export(place, cohort, effort, _parts(cell, place, cohort, effort, watch))
    model = open_bundle(place.bundle, threads=1)
    return result_of(cell, model, cohort, effort, time.perf_counter() - begin, watch)


def prepared(cohort: Cohort, config: TrainingConfig, run: Path) -> Run:
    """A training from where it was left; what a killed one left without a checkpoint is cleared away."""
    resume = (run / CHECKPOINT).is_file()
    if run.exists() and not resume:
        shutil.rmtree(run)
    return prepare(cohort, config, run, resume=resume)


def parts_of(cell: Cell) -> PriorParts | None:
    """What is fitted to the codes of a cell's training: nothing where the cell is plain."""
    return None if cell.prior is PriorName.PLAIN else PriorParts(flow=cell.prior.flow, ard=cell.prior.ard)


def _parts(cell: Cell, place: Place, cohort: Cohort, effort: Effort, watch: Watch) -> PriorParts | None:
    """What is fitted, with as much of the training's prior as validation shapes want.

    They want it at the likelihood precision that the cell is measured with; one that is not calibrated has but one.
    """
    parts = parts_of(cell)
    if parts is None or cell.together or not cohort.validation:
        return parts
    precisions = PRECISIONS if effort.calibrate else (UNCALIBRATED_PRECISION,)
    numbers, most = count(1), len(precisions) + FITTED

    def advance() -> None:
        watch("choosing the prior", next(numbers), most)

    watch("choosing the prior", 0, most)
    return chosen_parts(place.run, parts, cohort.validation, cell.measured_in, precisions, advance).parts


def config_of(cell: Cell, cohort: Cohort, effort: Effort, device: DeviceName) -> TrainingConfig:
    """The configuration of a cell's training."""
    choice = TrainingChoice(
        ObjectiveName(cell.objective),
        RegimeName(cell.regime),
        cell.latent_size,
        flow=cell.together and cell.prior.flow,
        ard=cell.together and cell.prior.ard,
        reflect=effort.reflect,
        steps=effort.steps,
        patience=effort.patience,
        seed=cell.seed,
        device=device,
    )
    return configured_for(cohort, choice)


def result_of(cell: Cell, model: ShapeModel, cohort: Cohort, effort: Effort, seconds: float, watch: Watch) -> Result:
    """Measure an exported cell.

    Raises:
        InvalidParameter: the cohort has no test shapes, or the model was trained on one that is measured.
    """
    check_test(cohort)
    cases = cohort.test[: effort.cases]
    check_unseen(model.manifest, cases, "test")
    sigmas = relevance(model.manifest)
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
        shapes=shapes_of(model.manifest),
        steps=steps_of(model.manifest),
        seconds=round(seconds, 1),
        sigmas=sorted(sigmas, reverse=True),
        active=list(active_dimensions(np.array(sigmas))),
        latent=drawn.latent.round(4).tolist(),
        surface_mm=drawn.surface_mm.round(4).tolist(),
        measured={regime: _measured(model, cases, regime, watch) for regime in cell.measured_in},
    )


def check_test(cohort: Cohort) -> None:
    """Refuse a cohort on which nothing can be measured.

    Raises:
        InvalidParameter: it has no test shapes.
    """
    if not cohort.test:
        raise InvalidParameter(
            "The cohort has no test shapes; one with a test split, or --test-fraction, is accepted.", part="cohort"
        )


def steps_of(manifest: Manifest) -> int:
    """Steps that the configuration in a manifest asks for."""
    config = manifest.training["config"]
    return int(config["steps"]) if isinstance(config, dict) else 0


def shapes_of(manifest: Manifest) -> int:
    """Shapes that a model was trained on, as its manifest says."""
    facts: Any = manifest.training
    return int(facts["shapes"])


def relevance(manifest: Manifest) -> list[float]:
    """Sigmas by which dimensions are told relevant: of the prior that was fitted, else all that were trained."""
    facts: Any = manifest.training.get("pruned") or {}
    return list(facts["trained_sigmas"] if facts and not facts.get("fitted") else manifest.sigmas)


def by_cell(bundles: Sequence[Path]) -> dict[Cell, Path]:
    """Exported bundles under the cells that they belong to.

    Raises:
        InvalidParameter: one is not there, or two belong to one cell.
    """
    found: dict[Cell, Path] = {}
    for bundle in bundles:
        cell = cell_of(given_bundle(bundle))
        if cell in found:
            raise InvalidParameter(
                f"Two bundles belong to the cell {cell.key}; one is accepted, the other in a folder of its own.",
                part="bundle",
            )
        found[cell] = bundle
    return found


def adopt(bundle: Path, place: Place) -> None:
    """Take an exported bundle as a cell's own; other processes may do so at the same time.

    Raises:
        InvalidParameter: the cell has another one.
    """
    manifest = given_bundle(bundle)
    if not place.bundle.exists():
        _copy(bundle, place.bundle)
    if read_manifest(place.bundle)[0] != manifest:
        raise InvalidParameter(
            f"The output folder holds another bundle as the cell {place.bundle.parent.name}; the same one, or an empty "
            "folder, is accepted.",
            part="bundle",
        )


def _copy(bundle: Path, target: Path) -> None:
    """In one move, so that a folder that is there is a whole one; the first of several processes has its way."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix="adopting-") as folder:
        whole = shutil.copytree(bundle, Path(folder) / target.name)
        try:
            whole.rename(target)
        except OSError:
            if not target.exists():
                raise


def _export(place: Place, cohort: Cohort, effort: Effort, parts: PriorParts | None) -> None:
    part = place.bundle.with_name(f"{place.bundle.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    export_run(place.run, part, parts=parts)
    if effort.calibrate and cohort.validation:
        _calibrate(part, place, cohort)
    part.rename(place.bundle)


def _calibrate(part: Path, place: Place, cohort: Cohort) -> None:
    """As the plain cell of the training was, where that is done: what differs between the two is the prior's then."""
    known = read_manifest(place.plain)[0] if is_exported(place.plain) else None
    if known is not None and known.calibration:
        calibrate_bundle_as(part, known, cohort, threads=1)
    else:
        calibrate_bundle(part, cohort, threads=1)


def _measured(
    model: ShapeModel, cases: Sequence[Case], regime: Regime, watch: Watch
) -> dict[str, dict[str, float] | None]:
    fill = fills_of(model, 0)[Method.MODEL]
    found: dict[str, dict[str, float] | None] = {}
    for number, case in enumerate(cases):
        drawing = for_evaluation(case.mask, case.grid, regime)
        agreement = measure(case, regime, drawing, Method.MODEL, fill).agreement
        found[case.name] = None if agreement is None else {name: getattr(agreement, name) for name in FIGURES}
        watch(f"measuring {regime}", number + 1, len(cases))
    return found
