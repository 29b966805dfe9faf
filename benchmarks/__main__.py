"""``python -m benchmarks``: time of a request and, where a cohort lies at hand, accuracy beside interpolation."""

from typing import Annotated

import typer

from benchmarks import request
from training.choices import RegimeName
from training.cohort_options import DataOption
from training.cohorts import CohortName
from training.evaluate_command import evaluate


def main(
    model: Annotated[str, typer.Option(help="Name of a shipped model.")] = "hippocampus",
    cohort: Annotated[CohortName, typer.Option(help="Cohort of the model.")] = CohortName.HIPPOCAMPUS,
    data: DataOption = None,
    cases: Annotated[int, typer.Option(min=1, max=200, help="Test cases, at most.")] = 10,
    repeats: Annotated[int, typer.Option(min=1, max=200, help="Requests for each case and kind.")] = 3,
) -> None:
    """Time and accuracy on this machine."""
    there = data is not None and (data / cohort).is_dir()
    request.main(model, cohort=cohort if there else None, data=data, cases=cases, repeats=repeats)
    if not there:
        typer.echo("No cohort in the data folder: the example mask was sent, accuracy was not measured.", err=True)
        return
    typer.echo()
    regimes = [RegimeName.THIN, RegimeName.THICK, RegimeName.ORTHOGONAL]
    evaluate(model=model, cohort=cohort, data=data, regime=regimes, limit=cases)


if __name__ == "__main__":
    typer.run(main)
