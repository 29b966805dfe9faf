"""``python -m benchmarks.generator``: the table of a bundle's generator and what it reached."""

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.generator.first_byte import first_byte_s
from benchmarks.generator.measuring import Plan, measured
from benchmarks.generator.table import Figure, markdown
from training.choices import SplitName
from training.cohort_options import DataOption
from training.cohorts import CohortName, CohortOptions, data_folder, load_cohort
from training.console import exit_status, progress
from training.evaluate import find_bundle, open_named, shipped_bundles

#: Parts of the measurement, the service's first byte among them.
PARTS = 8


def run(
    model: Annotated[str, typer.Option(help="Name of a shipped model, or the folder of a bundle.")],
    cohort: Annotated[CohortName, typer.Option(help="The cohort that it was trained on.")],
    samples: Annotated[int, typer.Option(min=20, help="Draws of the prior.")] = 1500,
    compared: Annotated[int, typer.Option(min=10, help="Draws compared with the whole population.")] = 200,
    fitted: Annotated[int, typer.Option(min=2, help="Training and held-out masks that are fitted, each.")] = 20,
    timed: Annotated[int, typer.Option(min=1, help="Draws at full resolution that are timed.")] = 24,
    spacing_mm: Annotated[float, typer.Option(min=0.5, max=5.0, help="Grid step of compared surfaces (mm).")] = 2.0,
    split: Annotated[SplitName, typer.Option(help="Held-out masks.")] = SplitName.VALIDATION,
    data: DataOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Of validation persons, the one used in training.")] = 0,
    service: Annotated[bool, typer.Option("--service/--no-service", help="Time the service as well.")] = True,
    output: Annotated[Path | None, typer.Option(help="Markdown file to write as well.")] = None,
) -> None:
    """Measure a bundle's generator."""
    with exit_status(), progress(PARTS, f"measuring {model}") as bar:
        opened = open_named(model)
        options = CohortOptions(seed=seed, skip_refused=True)
        found = load_cohort(cohort, data_folder(data), options)
        plan = Plan(samples, compared, fitted, timed, spacing_mm, seed)
        figures: list[Figure] = []
        for part in measured(opened, found, found.of_split(split.value), plan):
            figures += part
            bar.advance(bar.task_ids[0])
        if service:
            waited = first_byte_s(find_bundle(model, [shipped_bundles()]), opened.manifest.name)
            figures.append(Figure("first byte of a ZIP of 16 (s)", waited, limit=0.5))
        manifest = opened.manifest
        text = markdown(f"{manifest.name} {manifest.version}, {samples} draws", figures)
        typer.echo(text)
        if output is not None:
            output.write_text(text, encoding="utf-8")


def main() -> None:
    """The program."""
    typer.run(run)
