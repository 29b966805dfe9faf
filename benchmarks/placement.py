"""``python -m benchmarks.placement``: accuracy when the same drawing lies elsewhere, is turned, or is mirrored.

The drawing's affine is changed, not its voxels: the reconstruction has to come back in the new place as good as before.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from model.bundle import ShapeModel, open_bundle
from model.geometry import Grid
from model.inference.fitting import MirrorRule
from model.inference.one_body import body_mask
from model.inference.reconstruction import Options, reconstruct
from training.cohort_options import DataOption
from training.cohorts import Case, CohortName, CohortOptions, data_folder, load_cohort
from training.console import exit_status
from training.evaluate import find_bundle, shipped_bundles
from training.metrics_masks import MaskAgreement, agreement
from training.sparsify import Regime, for_evaluation

REGIMES: tuple[Regime, ...] = ("orthogonal", "thin")
OFFSET_MM = (20.0, -20.0, 20.0)


@dataclass(frozen=True)
class Placement:
    """A change of a drawing's place.

    Attributes:
        name: in the table.
        affine: (4, 4) from the old world to the new one (RAS mm).
        mirror: what the fit is told.
    """

    name: str
    affine: Float[np.ndarray, "4 4"]
    mirror: MirrorRule = "never"


def placements() -> Iterator[Placement]:
    """As drawn, 20 mm off along each axis, turned about each axis, and left for right."""
    yield Placement("as drawn", np.eye(4))
    yield Placement("as drawn, either side", np.eye(4), "auto")
    yield Placement("20 mm along each axis", _affine(np.eye(3), OFFSET_MM))
    for degrees in (10, 20, -20):
        for axis, name in enumerate("RAS"):
            turn = Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis]).as_matrix()
            yield Placement(f"{degrees} degrees about {name}", _affine(turn, (0.0, 0.0, 0.0)))
    yield Placement("left for right", np.diag([-1.0, 1.0, 1.0, 1.0]), "auto")


def _affine(linear: Float[np.ndarray, "3 3"], offset: tuple[float, float, float]) -> Float[np.ndarray, "4 4"]:
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = linear, offset
    return affine


def measure(model: ShapeModel, case: Case, regime: Regime, placement: Placement) -> MaskAgreement:
    """Agreement of a case with its reconstruction from a drawing that lies elsewhere."""
    drawing = for_evaluation(case.mask, case.grid, regime)
    grid = drawing.stack.grid
    stack = replace(drawing.stack, grid=replace(grid, affine=placement.affine @ grid.affine))
    options = Options(annotated=drawing.planes, uncertainty="none", mirror=placement.mirror)
    found = reconstruct(model, [stack], options)
    there = Grid(case.grid.shape, placement.affine @ case.grid.affine)
    return agreement(case.mask, body_mask(model, found.state, found.mesh, there), there.spacing)


def main(
    model: Annotated[str, typer.Option(help="Name of a shipped model, or the folder of a bundle.")] = "hippocampus",
    cohort: Annotated[CohortName, typer.Option(help="Cohort of the model.")] = CohortName.HIPPOCAMPUS,
    data: DataOption = None,
    cases: Annotated[int, typer.Option(min=1, max=200, help="Test cases, at most.")] = 30,
) -> None:
    """Accuracy of the same drawings in other places."""
    with exit_status():
        opened = open_bundle(find_bundle(model, [shipped_bundles()]))
        chosen = load_cohort(cohort, data_folder(data), CohortOptions()).test[:cases]
    typer.echo(f"{'placement':24}{'regime':12}{'Dice':>8}{'ASD mm':>8}")
    for placement in placements():
        for regime in REGIMES:
            found = [measure(opened, case, regime, placement) for case in chosen]
            dice, asd = np.mean([one.dice for one in found]), np.mean([one.asd_mm for one in found])
            typer.echo(f"{placement.name:24}{regime:12}{dice:8.3f}{asd:8.3f}")


if __name__ == "__main__":
    typer.run(main)
