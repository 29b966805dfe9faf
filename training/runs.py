"""A training run's folder: what it was made of, its checkpoint, its figures; and continuing it."""

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.tensorboard import SummaryWriter

from model.errors import InvalidParameter
from training.autodecoder import CHECKPOINT, AutoDecoder, Trainer, Watch, is_ended, train
from training.cohorts.cohort import Case, Cohort, evenly
from training.config import TrainingConfig, config_from_dict
from training.difference import first_difference
from training.placing import reach_with_voxels
from training.points import cohort_points, cuts_are_ends, decoder_extent
from training.saved import intact, read_state, write_json
from training.seen import short_digest
from training.stopping import EarlyStopping
from training.validation import Validation

RECORD = "run.json"
#: Folder of TensorBoard events.
FIGURES = "figures"
#: Evenly spaced held-out shapes that are measured during training, at most.
VALIDATED = 32


@dataclass(frozen=True)
class Run:
    """A training in its folder, ready to go on from where an earlier attempt left it."""

    trainer: Trainer
    cohort: Cohort
    folder: Path

    def go(self, watch: Watch = lambda step, figures: None) -> AutoDecoder:
        """Train to the end; leaves ``checkpoint.pt`` and the figures."""
        trainer = self.trainer
        with SummaryWriter(self.folder / FIGURES, purge_step=trainer.step) as writer:
            logging = _logging_watch(writer, watch)
            stopping = EarlyStopping(trainer, self.folder)
            return train(trainer, self.folder, _validating_watch(trainer, self.cohort, writer, logging, stopping))


def prepare(cohort: Cohort, config: TrainingConfig, folder: Path, *, resume: bool = False) -> Run:
    """Points on the device, the module and its checkpoint, if there is one; leaves ``run.json``.

    Raises:
        InvalidParameter: the folder holds a run and `resume` is off, or its run was made of something else.
    """
    if not resume:
        check_free(folder)
    shapes = cohort_points(cohort.train, config.regime, config.seed, torch.get_num_threads())
    if config.reflected:
        shapes += [shape.reflected() for shape in shapes]
    config = replace(config, decoder=replace(config.decoder, extent_mm=decoder_extent(shapes)))
    checkpoint = folder / CHECKPOINT
    _check_same(folder, record(cohort, config))
    trainer = Trainer.start(config, shapes)
    if resume and checkpoint.is_file():
        trainer.load(checkpoint)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / RECORD, record(cohort, config))
    return Run(trainer, cohort, folder)


def train_cohort(
    cohort: Cohort,
    config: TrainingConfig,
    folder: Path,
    *,
    resume: bool = False,
    watch: Watch = lambda step, figures: None,
) -> AutoDecoder:
    """Train on a cohort's training split; leaves ``run.json``, ``checkpoint.pt`` and the figures.

    Raises:
        InvalidParameter: the folder holds a run and `resume` is off, or its run was made of something else.
    """
    return prepare(cohort, config, folder, resume=resume).go(watch)


def is_finished(folder: Path, cohort: Cohort, config: TrainingConfig) -> bool:
    """Whether the folder holds a run of these masks and settings, on whatever device, that has reached its end."""
    if not (folder / CHECKPOINT).is_file() or not (folder / RECORD).is_file():
        return False
    there, values = read_record(folder)
    decoder = replace(config.decoder, extent_mm=there.decoder.extent_mm)
    wanted = record(cohort, replace(config, decoder=decoder, device=there.device))
    if _difference(values, there, wanted):
        return False
    state = read_state(folder / CHECKPOINT, "cpu", mmap=True)
    with intact(CHECKPOINT):
        return is_ended(state, there)


def record(cohort: Cohort, config: TrainingConfig) -> dict[str, Any]:
    """What a run is made of, as plain values: configuration, cohort and the cases with the hashes of their masks."""
    copies = 2 if config.reflected else 1
    return {
        "config": config.as_dict(),
        "cohort": cohort.name,
        "side": cohort.recorded_side,
        "source": cohort.source,
        "licence": cohort.licence,
        "attribution": cohort.attribution,
        "shippable": cohort.provenance.shippable,
        "train": {case.name: mask_digest(case) for case in cohort.train},
        "voxel_digests": [short_digest(case) for case in cohort.train],
        "codes": copies * len(cohort.train),
        "volumes_ml": copies * [case.volume_ml for case in cohort.train],
        "half_extent_mm": half_extent(cohort),
        "validation": [case.name for case in cohort.validation],
        "refused": {refusal.name: refusal.reason for refusal in cohort.refused},
    }


def half_extent(cohort: Cohort) -> list[float]:
    """Half size of the canonical box that holds every training shape, voxels included (mm along R, A, S)."""
    reaches = [reach_with_voxels(case.mask, case.grid) for case in cohort.train]
    return [float(value) for value in np.max(reaches, axis=0)]


def read_record(folder: Path) -> tuple[TrainingConfig, dict[str, Any]]:
    """Configuration and record of a run.

    Raises:
        InvalidParameter: the folder holds no run, or a damaged one.
    """
    path = folder / RECORD
    if not path.is_file():
        raise InvalidParameter(
            "The folder holds no training run; one written by morphoflow train is accepted.", part="run"
        )
    with intact(RECORD):
        values = json.loads(path.read_text(encoding="utf-8"))
        return config_from_dict(values["config"]), values


def mask_digest(case: Case) -> str:
    """SHA-256 over shape, place and voxels of a mask."""
    head = repr((case.mask.shape, case.grid.affine.tolist())).encode()
    return hashlib.sha256(head + case.mask.tobytes()).hexdigest()


def check_free(folder: Path) -> None:
    """Refuse to write over a run.

    Raises:
        InvalidParameter: the folder holds one.
    """
    if (folder / RECORD).is_file():
        raise InvalidParameter(
            "The output folder holds a run already; an empty folder, or --resume, is accepted.", part="output"
        )


def check_begun(folder: Path) -> None:
    """Refuse to continue what never began.

    Raises:
        InvalidParameter: the folder holds no run.
    """
    if not (folder / RECORD).is_file():
        raise InvalidParameter(
            "The output folder holds no run to resume; without --resume a new one begins there.", part="output"
        )


def _check_same(folder: Path, wanted: dict[str, Any]) -> None:
    if not (folder / RECORD).is_file():
        return
    config, there = read_record(folder)
    found = _difference(there, config, wanted)
    if found:
        raise InvalidParameter(
            f"The run in the output folder was made of other masks or settings ({found}); the same ones are accepted.",
            part="resume",
        )


def _difference(values: dict[str, Any], config: TrainingConfig, wanted: dict[str, Any]) -> str:
    """In what a record that was read differs from the one that is wanted; fields not there yet have their defaults."""
    # Digests of voxels may be of an earlier kind; masks are told by those of ``train``.
    known = {**values, "voxel_digests": wanted["voxel_digests"], "config": json.loads(json.dumps(config.as_dict()))}
    return first_difference(known, json.loads(json.dumps(wanted)))


def _validating_watch(
    trainer: Trainer, cohort: Cohort, writer: SummaryWriter, watch: Watch, stopping: EarlyStopping
) -> Watch:
    config = trainer.config
    if not cohort.validation:
        return watch
    chosen, ends = evenly(cohort.validation, VALIDATED), cuts_are_ends(cohort.train)
    points = cohort_points(chosen, "dense", config.seed, torch.get_num_threads(), cut_is_end=ends)
    validation = Validation(config, points)

    def validate(step: int, figures: dict[str, float]) -> None:
        watch(step, figures)
        if step % config.validate_every == 0 or step == config.steps:
            found = validation.figures(trainer.module)
            for name, value in found.items():
                writer.add_scalar(name, value, step)
            stopping.see(found)

    return validate


def _logging_watch(writer: SummaryWriter, watch: Watch) -> Watch:
    def both(step: int, figures: dict[str, float]) -> None:
        for name, value in figures.items():
            writer.add_scalar(name, value, step)
        watch(step, figures)

    return both
