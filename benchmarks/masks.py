"""``python -m benchmarks.masks``: a label map near its surface alone, beside the same by the value at every voxel.

Test shapes from three orthogonal slices, on the grids that they were drawn on and around their surfaces at a spacing of
choice: seconds of either (processor time), the most memory that each takes beyond what it began with, and the voxels
in which they differ.
"""

import time
import tracemalloc
from collections.abc import Callable
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Bool

from model.geometry import Grid
from model.inference.one_body import OCCUPIED, body_mask, body_probability
from model.inference.reconstruction import Options, Reconstruction, reconstruct
from model.inference.surface import covering_grid
from training.cohort_options import DataOption
from training.cohorts import CohortName, CohortOptions, data_folder, load_cohort
from training.cohorts.cohort import evenly
from training.console import exit_status
from training.evaluate import open_named
from training.sparsify import for_evaluation

Fill = Callable[[], Bool[np.ndarray, "i j k"]]


def measured(fill: Fill) -> tuple[Bool[np.ndarray, "i j k"], float, float]:
    """The mask, the seconds that it took, and in a second run the most memory that it held (MB)."""
    begin = time.process_time()
    mask = fill()
    seconds = time.process_time() - begin
    tracemalloc.start()
    fill()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return mask, seconds, peak / 1e6


def main(
    model: Annotated[str, typer.Option(help="Name of a shipped model, or the folder of a bundle.")] = "hippocampus",
    cohort: Annotated[CohortName, typer.Option(help="Cohort of the model.")] = CohortName.HIPPOCAMPUS,
    data: DataOption = None,
    cases: Annotated[int, typer.Option(min=1, help="Test cases, at most.")] = 5,
    spacing_mm: Annotated[float, typer.Option(min=0.1, max=5.0, help="Of the second grid.")] = 0.5,
) -> None:
    """Masks near the surface beside masks of all voxels."""
    with exit_status():
        opened = open_named(model)
        found = load_cohort(cohort, data_folder(data), CohortOptions(skip_refused=True))
    typer.echo(
        f"{'grid':22}{'voxels':>12}{'near s':>9}{'all s':>9}{'times':>7}{'near MB':>9}{'all MB':>8}{'differ':>8}"
    )

    def line(name: str, answer: Reconstruction, grid: Grid) -> None:
        near, near_s, near_mb = measured(lambda: body_mask(opened, answer.state, answer.mesh, grid))
        full, full_s, full_mb = measured(lambda: body_probability(opened, answer.state, answer.mesh, grid) >= OCCUPIED)
        numbers = f"{near.size:12d}{near_s:9.2f}{full_s:9.2f}{full_s / near_s:7.1f}{near_mb:9.1f}{full_mb:8.1f}"
        typer.echo(f"{name:22}{numbers}{np.count_nonzero(near != full):8d}")

    for case in evenly(found.test, cases):
        drawing = for_evaluation(case.mask, case.grid, "orthogonal")
        answer = reconstruct(opened, [drawing.stack], Options(annotated=drawing.planes, uncertainty="none"))
        line(case.name[:21], answer, case.grid)
        line(f"  at {spacing_mm:g} mm", answer, covering_grid(answer.mesh, spacing_mm))


if __name__ == "__main__":
    typer.run(main)
