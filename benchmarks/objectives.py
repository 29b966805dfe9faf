"""``python -m benchmarks.objectives``: training objectives side by side, the paper's among them.

Each objective trains one model for so many steps, with flow and ARD along; a run that was ended goes on where it
stopped. Beside them stands the default, in which both are fitted to the codes of a finished training. Codes of training
and of held-out shapes are then fitted in the same way, so that their densities can be compared.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import typer
from jaxtyping import Float
from torch import Tensor

from training.autodecoder import AutoDecoder
from training.choices import ObjectiveName, RegimeName, TrainingChoice
from training.cohort_options import DataOption
from training.cohorts import Cohort, CohortName, CohortOptions, data_folder, load_cohort
from training.config import TrainingConfig
from training.configuring import configured_for
from training.console import exit_status, progress
from training.points import cohort_points
from training.pruning import refitted
from training.release import active_dimensions
from training.runs import half_extent, train_cohort
from training.validation import Validation

#: Shapes of each split whose codes are fitted.
SHAPES = 24
#: Dimensions count as dead when without all of them Dice falls by less.
DEAD_DICE = 0.001


@dataclass(frozen=True)
class Row:
    """Figures of one objective.

    Attributes:
        sigma_ratio: largest sigma by smallest.
        active: dimensions that hold 95, 97 and 99 % of the base variance.
        dead: dimensions without which Dice stays, those of the smallest sigmas.
        train_density, held_out_density: mean log prior density of fitted codes (nats a dimension).
        train_dice, held_out_dice: soft Dice of fitted codes.
    """

    sigma_ratio: float
    active: tuple[int, int, int]
    dead: int
    train_density: float
    held_out_density: float
    train_dice: float
    held_out_dice: float


def configuration(objective: ObjectiveName, steps: int, cohort: Cohort, *, together: bool = True) -> TrainingConfig:
    """The objective with its own defaults; mirror images are left out, so that all see the same shapes."""
    choice = TrainingChoice(objective, RegimeName.DENSE, 64, flow=together, ard=together, reflect=False, steps=steps)
    return configured_for(cohort, choice)


def trained(cohort: Cohort, config: TrainingConfig, folder: Path) -> AutoDecoder:
    """The finished run of a folder, or one that is begun or continued there."""
    with progress(config.steps, f"training {config.objective.name}") as bar:

        def watch(step: int, _figures: dict[str, float]) -> None:
            bar.update(bar.task_ids[0], completed=step)

        return train_cohort(cohort, config, folder, resume=True, watch=watch).eval()


def in_two_stages(module: AutoDecoder, cohort: Cohort) -> AutoDecoder:
    """The finished module over its relevant dimensions, with the prior that is fitted to its codes."""
    less = refitted(module.cpu(), len(cohort.train), half_extent(cohort))
    decoder = replace(module.config.decoder, latent_size=len(less.prior.sigma), unit_columns=False)
    result = AutoDecoder(replace(module.config, decoder=decoder, prior=less.prior.shape), len(less.codes))
    result.decoder, result.prior = less.decoder, less.prior
    with torch.no_grad():
        result.mean.copy_(less.codes / less.prior.sigma)
    return result.to(module.config.device).eval()


def measured(module: AutoDecoder, cohort: Cohort, config: TrainingConfig) -> Row:
    """Figures of a trained model."""
    seen, unseen = (
        Validation(config, cohort_points(cases[:SHAPES], "dense", 0)) for cases in (cohort.train, cohort.validation)
    )
    codes = [found.fitted(module) for found in (seen, unseen)]
    with torch.no_grad():
        densities = [float(module.prior.log_density(one).mean()) / one.shape[1] for one in codes]
    sigmas = module.prior.sigma.detach().cpu().numpy().astype(float)
    return Row(
        sigma_ratio=float(sigmas.max() / sigmas.min()),
        active=active_dimensions(sigmas),
        dead=dead_dimensions(module, unseen, codes[1]),
        train_density=densities[0],
        held_out_density=densities[1],
        train_dice=seen.agreement(module, codes[0])[1],
        held_out_dice=unseen.agreement(module, codes[1])[1],
    )


def dead_dimensions(module: AutoDecoder, shapes: Validation, codes: Float[Tensor, "m d"]) -> int:
    """How many dimensions, smallest sigma first, can be set to the training codes' mean before Dice falls."""
    order = torch.argsort(module.prior.sigma.detach())
    mean = module.code_means().detach().mean(dim=0)
    least = shapes.agreement(module, codes)[1] - DEAD_DICE

    def holds(count: int) -> bool:
        changed = codes.clone()
        changed[:, order[:count]] = mean[order[:count]]
        return shapes.agreement(module, changed)[1] >= least

    return next((count - 1 for count in range(1, len(order) + 1) if not holds(count)), len(order))


def lines(rows: dict[str, Row]) -> Iterator[str]:
    """The table, in Markdown; gap is what held-out shapes lack in log density."""
    yield "| objective | sigmas | 95-97-99 % | dead | log density, train | held out | gap | Dice, train | held out |"
    yield "| --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    for name, row in rows.items():
        active = "-".join(map(str, row.active))
        yield (
            f"| {name} | {row.sigma_ratio:.3g} | {active} | {row.dead} | {row.train_density:.2f} | "
            f"{row.held_out_density:.2f} | {row.train_density - row.held_out_density:.2f} | "
            f"{row.train_dice:.3f} | {row.held_out_dice:.3f} |"
        )


def main(
    cohort: Annotated[CohortName, typer.Option(help="Cohort to train on.")] = CohortName.HIPPOCAMPUS,
    data: DataOption = None,
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps of each.")] = 2000,
    objective: Annotated[list[ObjectiveName] | None, typer.Option(help="May repeat; all when left out.")] = None,
    folder: Annotated[Path, typer.Option(help="Folder of the runs.")] = Path("build/objectives"),
) -> None:
    """Train one model with each objective and compare them."""
    with exit_status():
        found = load_cohort(cohort, data_folder(data), CohortOptions(skip_refused=True))
    rows: dict[str, Row] = {}
    for name in objective or list(ObjectiveName):
        config = configuration(name, steps, found)
        module = trained(found, config, folder / f"{found.name}-{name}-{steps}")
        rows[name.value] = measured(module, found, module.config)
    if objective is None:
        config = configuration(ObjectiveName.VARIATIONAL, steps, found, together=False)
        module = in_two_stages(trained(found, config, folder / f"{found.name}-two-stages-{steps}"), found)
        rows["in two stages"] = measured(module, found, module.config)
    typer.echo("\n".join(lines(rows)))


if __name__ == "__main__":
    typer.run(main)
