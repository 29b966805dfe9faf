"""Early stopping: the best module by its validation figure is kept, and comes back when nothing better follows."""

from pathlib import Path
from typing import Any

import torch

from training.autodecoder import Trainer
from training.saved import read_state

#: The figure that is watched (nats a band voxel, less is better) and the file of the best module.
FIGURE, BEST = "validation/cross_entropy", "best.pt"


class EarlyStopping:
    """Watches the validation figure of a run in its folder; what it knows survives a kill.

    A run is stopped when the best figure is older than ``patience`` validations. It then holds the best module, and
    that is exported. Without patience nothing is stopped or put back.
    """

    def __init__(self, trainer: Trainer, folder: Path) -> None:
        self._trainer = trainer
        self._path = folder / BEST
        self._best: dict[str, Any] | None = None
        if trainer.config.patience and trainer.step > 0 and self._path.is_file():
            self._best = read_state(self._path, trainer.pool.device)

    def see(self, figures: dict[str, float]) -> None:
        """Take a validation's figures; ends the run when its time is up."""
        trainer = self._trainer
        if not trainer.config.patience:
            return
        value = figures[FIGURE]
        if self._best is None or value < self._best["figure"]:
            self._keep(value)
        elif trainer.step - self._best["step"] >= trainer.config.patience * trainer.config.validate_every:
            trainer.finished = True
        if trainer.finished or trainer.step == trainer.config.steps:
            trainer.module.load_state_dict(self._best["module"] if self._best else trainer.module.state_dict())

    def _keep(self, value: float) -> None:
        state = {name: tensor.clone() for name, tensor in self._trainer.module.state_dict().items()}
        self._best = {"figure": value, "step": self._trainer.step, "module": state}
        part = self._path.with_suffix(".part")
        torch.save(self._best, part)
        part.replace(self._path)
