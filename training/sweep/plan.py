"""The cells of a sweep: every combination of latent size, regime, prior and seed; and the trainings behind them."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from model.bundle import Manifest
from training.config import Regime, config_from_dict
from training.sweep.priors import PriorName


@dataclass(frozen=True, order=True)
class Cell:
    """One model that is measured.

    Attributes:
        regime: of the drawings that are trained on.
        latent_size: D.
        prior: with or without flow and ARD.
        seed: of held-out persons, drawings and training.
        objective: what is minimised.
    """

    regime: Regime
    latent_size: int
    prior: PriorName
    seed: int = 0
    objective: str = "variational"

    @property
    def key(self) -> str:
        """Name of the cell in tables and folders."""
        return f"{self.regime}-d{self.latent_size}-{self.prior}-{self.objective}-s{self.seed}"

    @property
    def together(self) -> bool:
        """Whether the prior is trained along with the decoder; it is fitted to the finished codes otherwise."""
        return self.objective != "variational"

    @property
    def training_key(self) -> str:
        """Name of the training; cells that differ in what is fitted to its codes share it."""
        return self.key if self.together else f"{self.regime}-d{self.latent_size}-{self.objective}-s{self.seed}"

    @property
    def measured_in(self) -> tuple[Regime, ...]:
        """Regimes of the drawings that it is measured with: its own, all sparse ones after dense training."""
        return ("thin", "thick", "orthogonal") if self.regime == "dense" else (self.regime,)


def cells_of(
    latent_sizes: Iterable[int],
    regimes: Iterable[Regime],
    priors: Iterable[PriorName],
    seeds: Iterable[int],
    objective: str,
) -> list[Cell]:
    """Every combination once, small latent sizes first, and of a training the plain cell, which the others look at."""
    plain_first = sorted(priors, key=lambda prior: prior is not PriorName.PLAIN)
    found = itertools.product(sorted(set(latent_sizes)), regimes, plain_first, seeds)
    return list(dict.fromkeys(Cell(regime, size, prior, seed, objective) for size, regime, prior, seed in found))


def by_training(cells: Iterable[Cell]) -> dict[str, list[Cell]]:
    """Cells under the keys of their trainings, in the order in which these first appear."""
    found: dict[str, list[Cell]] = {}
    for cell in cells:
        found.setdefault(cell.training_key, []).append(cell)
    return found


def cell_of(manifest: Manifest) -> Cell:
    """The cell that an exported bundle belongs to, by what its manifest says of training and prior."""
    values: Any = manifest.training["config"]
    config = config_from_dict(values)
    facts: Any = manifest.training.get("pruned") or {}
    fitted = facts.get("fitted") or {"flow": config.prior.use_flow, "ard": config.prior.use_ard}
    prior = PriorName.of(flow=fitted["flow"], ard=fitted["ard"])
    return Cell(config.regime, config.decoder.latent_size, prior, config.seed, config.objective.name)
