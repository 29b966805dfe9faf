"""The cells of a sweep: every combination of latent size, regime, prior and seed."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from model.bundle import Manifest
from training.config import Regime, config_from_dict
from training.sweep.priors import PriorName


@dataclass(frozen=True, order=True)
class Cell:
    """One training.

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
    """Every combination once, small latent sizes first."""
    found = itertools.product(sorted(set(latent_sizes)), regimes, priors, seeds)
    return list(dict.fromkeys(Cell(regime, size, prior, seed, objective) for size, regime, prior, seed in found))


def cell_of(manifest: Manifest) -> Cell:
    """The cell that an exported bundle belongs to, by the configuration in its manifest."""
    values: Any = manifest.training["config"]
    config = config_from_dict(values)
    prior = {(True, True): PriorName.FLOW_ARD, (True, False): PriorName.FLOW, (False, True): PriorName.ARD}.get(
        (config.prior.use_flow, config.prior.use_ard), PriorName.PLAIN
    )
    return Cell(config.regime, config.decoder.latent_size, prior, config.seed, config.objective.name)


def without(cells: Sequence[Cell], done: Iterable[str]) -> list[Cell]:
    """The cells whose keys are not done."""
    finished = set(done)
    return [cell for cell in cells if cell.key not in finished]
