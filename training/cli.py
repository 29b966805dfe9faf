"""The commands train, export, complete, calibrate, evaluate, sweep and report; torch is imported when one needs it.

Results go to standard output, what was refused or peculiar to standard error. Exit status: 0, 2 for input that
cannot be used (masks, models, values), 1 for a fault, 130 for a training that was interrupted.
"""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from model.errors import InvalidParameter
from training import expectations
from training.choices import (
    LEAST_MOVEMENT,
    LEAST_OF_TRAINING,
    DeviceName,
    ObjectiveName,
    RegimeName,
    TrainingChoice,
    anatomy_code,
    resolved,
)
from training.cohort_options import opened_cohort, require_use, takes_cohort
from training.cohorts import Cohort, CohortOptions
from training.cohorts.sources import CohortSource
from training.console import JsonOption, check_output, exit_status, finding_counts, progress, tell_findings, warn
from training.evaluate_command import evaluate
from training.reporting.command import report
from training.sweep.command import sweep

if TYPE_CHECKING:
    from model.bundle import Manifest
    from training.config import TrainingConfig
    from training.pruning import PriorParts
    from training.release import Naming


def register(app: typer.Typer) -> None:
    """Add the commands to an application."""
    app.command("train")(train)
    app.command("export")(export)
    app.command("complete")(complete)
    app.command("calibrate")(calibrate)
    app.command("evaluate")(evaluate)
    app.command("sweep")(sweep)
    app.command("report")(report)


@takes_cohort
def train(
    source: CohortSource,
    options: CohortOptions,
    regime: Annotated[RegimeName, typer.Option(help="How sparse the training shapes are made.")] = RegimeName.DENSE,
    objective: Annotated[ObjectiveName, typer.Option(help="What is minimised.")] = ObjectiveName.VARIATIONAL,
    latent_size: Annotated[int, typer.Option(min=1, max=1024, help="Dimensions of the latent code.")] = 64,
    steps: Annotated[int | None, typer.Option(min=1, help="Optimiser steps.")] = None,
    epochs: Annotated[int | None, typer.Option(min=1, help="Passes over the cohort, in place of --steps.")] = None,
    flow: Annotated[
        bool | None,
        typer.Option("--flow/--no-flow", help="Whether a flow is trained along, and not fitted by export."),
    ] = None,
    ard: Annotated[
        bool | None,
        typer.Option("--ard/--no-ard", help="Whether ARD acts along, and not when exporting."),
    ] = None,
    ard_weight: Annotated[
        float | None, typer.Option(min=0.0, help="Of --ard; more leaves fewer dimensions alive.")
    ] = None,
    isometry: Annotated[
        float,
        typer.Option(
            min=0.0,
            help="Weight of an even latent space, where one step moves the surfaces of all shapes as far; try 2.",
        ),
    ] = 0.0,
    reflect: Annotated[
        bool | None,
        typer.Option(
            "--reflect/--no-reflect",
            help="Whether mirror images join the training shapes; they do for structures without a side.",
        ),
    ] = None,
    patience: Annotated[
        int, typer.Option(min=0, help="End after so many validations without a better figure; 0 never does.")
    ] = 0,
    device: Annotated[DeviceName, typer.Option(help="Where to compute.")] = DeviceName.AUTO,
    output: Annotated[Path | None, typer.Option(help="Folder of the run; runs/COHORT-REGIME when left out.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the run in the output folder.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Train a shape model on a cohort of masks or of meshes."""
    with exit_status(goes_on="--resume goes on"):
        from training.configuring import check_patience, configured_for
        from training.runs import check_begun, check_free

        choice = TrainingChoice(
            objective,
            regime,
            latent_size,
            flow=flow,
            ard=ard,
            ard_weight=ard_weight,
            isometry=isometry,
            reflect=reflect,
            steps=steps,
            epochs=epochs,
            patience=patience,
            seed=options.seed,
            device=device,
        )
        if output is not None:
            check_output(output, is_folder=True)
        check_folder = check_begun if resume else check_free
        if output is not None:
            check_folder(output)
        found = opened_cohort(source, options)
        tell_findings(found)
        check_patience(found, patience)
        warn(expectations.of_training(found))
        config = configured_for(found, choice)
        folder = output or Path("runs") / f"{found.name}-{regime}"
        check_folder(folder)
        figures = _train_with_progress(found, config, folder, resume=resume)
        _print_run(found, config, folder, figures, as_json=as_json)


@takes_cohort
def export(
    source: CohortSource,
    options: CohortOptions,
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    output: Annotated[Path, typer.Option(help="Folder of the bundle; created.")],
    name: Annotated[str | None, typer.Option(help="Name of the model; the cohort's when left out.")] = None,
    version: Annotated[str, typer.Option(help="Version of the model.")] = "1",
    prune: Annotated[
        bool | None,
        typer.Option(
            "--prune/--no-prune",
            help="Fit flow and relevance to the codes and keep relevant dimensions alone; left out, it is done unless "
            "the training had a flow or ARD of its own.",
        ),
    ] = None,
    least_movement: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help=f"With pruning: what moves less than this share of the most goes; {LEAST_MOVEMENT:g} when left out.",
        ),
    ] = None,
    training_share: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=1.0,
            help="With pruning: the least that stays of the prior of the training, "
            f"{LEAST_OF_TRAINING:g} when left out; more where validation shapes of a cohort that is named want it.",
        ),
    ] = None,
    resolution_mm: Annotated[
        float, typer.Option(min=0.25, max=10.0, help="Grid step of surfaces (mm) unless a request names another.")
    ] = 1.0,
    anatomy: Annotated[
        str | None, typer.Option(help="SNOMED CT code of the structure and its meaning, '67453005 Talus'.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Export a run as a bundle that the service loads."""
    with exit_status():
        from training.export_choice import ExportChoice
        from training.release import Naming, wants_prior

        naming = Naming(name, version, anatomy_code(anatomy), resolution_mm)
        check_output(output, is_folder=True)
        choice = ExportChoice(prune, least_movement, training_share, by_cohort=source.is_given)
        parts = choice.parts(stood_still=wants_prior(run))
        require_use(source, options)
        if parts is not None and source.is_given:
            parts = _parts_for(run, parts, source, options)
        manifest = _exported_with_progress(run, output, parts, naming)
        summary = {
            "bundle": str(output),
            "name": manifest.name,
            "version": manifest.version,
            "dimensions": manifest.latent_size,
        }
        typer.echo(json.dumps(summary) if as_json else f"{manifest.name} {manifest.version} written to {output}")


def _exported_with_progress(run: Path, output: Path, parts: "PriorParts | None", naming: "Naming") -> "Manifest":
    from training.release import STAGES, export_run

    with progress(len(STAGES), "exporting") as bar:

        def watch(words: str) -> None:
            bar.update(bar.task_ids[0], description=words, completed=STAGES.index(words))

        return export_run(run, output, parts, naming, watch)


def _parts_for(run: Path, parts: "PriorParts", source: CohortSource, options: CohortOptions) -> "PriorParts":
    from training.prior_choice import MODELS, check_own, chosen_parts

    found = opened_cohort(source, options)
    tell_findings(found)
    check_own(run, found.train)
    if not found.validation:
        raise InvalidParameter("The cohort has no validation cases; a larger one is accepted.", part="cohort")
    with progress(MODELS, f"choosing the prior on {found.name}") as bar:
        choice = chosen_parts(run, parts, found.validation, advance=lambda: bar.advance(bar.task_ids[0]))
    typer.echo(
        f"{100.0 * choice.parts.least_of_training:g} % of the training's prior stays at least: "
        f"validation shapes come out {choice.error:.3f} mm off, {choice.trained_error:.3f} mm as trained",
        err=True,
    )
    return choice.parts


@takes_cohort
def complete(
    source: CohortSource,
    options: CohortOptions,
    bundle: Annotated[Path, typer.Argument(help="Folder of an exported bundle; the network is put into it.")],
    run: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the checkpoint, from which training goes on; runs/COHORT-completion when left out."
        ),
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Optimiser steps.")] = None,
    reflect: Annotated[
        bool | None,
        typer.Option(
            "--reflect/--no-reflect",
            help="Whether it learns from mirror images as well; it does for structures with both sides or none.",
        ),
    ] = None,
    device: Annotated[DeviceName, typer.Option(help="Where to compute.")] = DeviceName.AUTO,
    as_json: JsonOption = False,
) -> None:
    """Train a network that completes drawings, for a model of many shapes, and put it into its bundle."""
    with exit_status():
        from training.completion.release import complete_bundle
        from training.completion.trainer import STEPS
        from training.evaluate import given_bundle

        given_bundle(bundle)
        if run is not None:
            check_output(run, is_folder=True)
        found = opened_cohort(source, options)
        tell_findings(found)
        warn(expectations.of_completion(found))
        folder = run or Path("runs") / f"{found.name}-completion"
        with progress(steps or STEPS, f"learning to complete {found.name}") as bar:
            config = complete_bundle(
                bundle,
                found,
                folder,
                reflect=reflect,
                steps=steps,
                seed=options.seed,
                device=resolved(device),
                watch=lambda step, loss: bar.update(bar.task_ids[0], completed=step),
            )
        summary = {"bundle": str(bundle), "voxels": list(config.voxels), "step_mm": config.step_mm}
        words = f"{config.voxels} voxels of {config.step_mm:g} mm; {bundle} is to be calibrated anew"
        typer.echo(json.dumps(summary) if as_json else words)


@takes_cohort
def calibrate(
    source: CohortSource,
    options: CohortOptions,
    bundle: Annotated[Path, typer.Argument(help="Folder of an exported bundle; its manifest is rewritten.")],
    as_json: JsonOption = False,
) -> None:
    """Choose on validation shapes how much a drawn mm^2 is worth and how far slices are followed; record both."""
    with exit_status():
        from model.bundle import read_manifest
        from training.calibration import calibrate_bundle, stages
        from training.evaluate import given_bundle

        before = given_bundle(bundle)
        found = opened_cohort(source, options)
        tell_findings(found)
        if not found.validation:
            raise InvalidParameter("The cohort has no validation cases; a larger one is accepted.", part="cohort")
        warn(expectations.of_calibration(found))
        with progress(stages(before), f"calibrating on {found.name}") as bar:
            chosen = calibrate_bundle(bundle, found, lambda: bar.advance(bar.task_ids[0]))
        best, manifest = chosen.best, read_manifest(bundle)[0]
        spread_mm, share = manifest.discrepancy["spread_mm"], manifest.completion.get("share")
        summary = {
            "likelihood_precision": best.precision,
            "fidelity": best.fidelity,
            "spread_mm": spread_mm,
            "posterior": manifest.posterior,
            "error_by_precision_and_fidelity": chosen.as_facts(),
            **{name: manifest.calibration[name] for name in ("cross_entropy_by_spread", "cross_entropy_by_sharpness")},
            **({} if share is None else {"completion_share": share}),
        }
        words = (
            f"likelihood precision {best.precision:g} per mm^2, fidelity {best.fidelity:g}, "
            f"spread {spread_mm:g} mm, sharpness {manifest.posterior['sharpness']:g} "
            f"({100.0 * chosen.errors[best]:.2f} % of voxels near the surface wrong)"
            + ("" if share is None else f", completed drawings count {share:g}")
        )
        typer.echo(json.dumps(summary) if as_json else words)


def _train_with_progress(cohort: Cohort, config: "TrainingConfig", folder: Path, *, resume: bool) -> dict[str, float]:
    from training.runs import train_cohort

    last: dict[str, float] = {}
    with progress(config.steps, f"training {cohort.name}") as bar:

        def watch(step: int, figures: dict[str, float]) -> None:
            last.update(figures)
            bar.update(bar.task_ids[0], completed=step)

        train_cohort(cohort, config, folder, resume=resume, watch=watch)
    return last


def _print_run(
    cohort: Cohort, config: "TrainingConfig", folder: Path, figures: dict[str, float], *, as_json: bool
) -> None:
    summary = {
        "run": str(folder),
        "steps": config.steps,
        "train": len(cohort.train),
        "validation": len(cohort.validation),
        "refused": {refusal.name: refusal.reason for refusal in cohort.refused},
        "findings": finding_counts(cohort),
        "figures": figures,
    }
    words = ", ".join(f"{name} {value:.4g}" for name, value in figures.items())
    typer.echo(json.dumps(summary) if as_json else f"{config.steps} steps in {folder}: {words or 'nothing left to do'}")
