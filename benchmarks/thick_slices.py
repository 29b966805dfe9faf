"""``python -m benchmarks.thick_slices``: volumes from thick slices, by what they were drawn by, of which nobody tells.

Axial slices of validation shapes, 4, 5 and 8 voxels thick, foreground where at least half of the thickness is filled,
where more than half is, and where the object lies at the slice's centre. An odd number of voxels is never half filled.
"""

from dataclasses import dataclass
from typing import Annotated, get_args

import numpy as np
import typer
from jaxtyping import Bool, Float

from model.bundle import ShapeModel, open_bundle
from model.geometry import Grid
from model.inference.fit_types import ThickRule
from model.inference.mask_stack import MaskStack, Plane
from model.inference.one_body import body_mask
from model.inference.reconstruction import Options, reconstruct
from training.cohort_options import DataOption
from training.cohorts import CohortName, CohortOptions, data_folder, load_cohort
from training.cohorts.cohort import Case, evenly
from training.console import exit_status
from training.evaluate import find_bundle, shipped_bundles
from training.metrics_masks import agreement
from training.sparsify import body_axes, centred_block, centred_offset

THICKNESSES = (4, 5, 8)
#: Planes that a drawing has at least.
LEAST_PLANES = 2


@dataclass(frozen=True)
class Answer:
    """A reconstruction from thick slices beside the truth.

    Attributes:
        asd_mm: average surface distance.
        volume_error: of the truth.
        is_held: whether the 90 % interval of the volume holds the truth.
        rule: by which the slices were taken to be drawn.
    """

    asd_mm: float
    volume_error: float
    is_held: bool
    rule: ThickRule


def drawn_by(rule: ThickRule, case: Case, count: int) -> tuple[MaskStack, tuple[Plane, ...]]:
    """A case on axial slices of so many voxels' thickness, centred in the object, and those that show some of it."""
    axial = body_axes(case.grid)[2]
    along = np.moveaxis(case.mask, axial, 0)
    is_section = rule == "section"
    first = (
        centred_offset(case.mask, axial, count) - count // 2 if is_section else centred_block(case.mask, axial, count)
    )
    first = first % count - (count if first % count else 0)
    blocks = -(-(len(along) - first) // count)
    padded = np.zeros((blocks * count, *along.shape[1:]), bool)
    padded[-first : len(along) - first] = along
    fine = padded.reshape(blocks, count, *along.shape[1:])
    labels = np.moveaxis(fine[:, count // 2] if is_section else _filled(fine.mean(axis=1), rule), 0, axial)
    centre = first + (count // 2 if is_section else (count - 1) / 2)
    shown = np.flatnonzero(labels.any(axis=tuple(np.delete(np.arange(3), axial))))
    stack = MaskStack("mask[0]", _thick_grid(case.grid, axial, centre, count, labels), labels, np.zeros_like(labels))
    return stack, tuple(Plane(0, axial, int(index)) for index in shown)


def _filled(share: Float[np.ndarray, "n a b"], rule: ThickRule) -> Bool[np.ndarray, "n a b"]:
    return share > 0.5 if rule == "more than half" else share >= 0.5


def _thick_grid(grid: Grid, axis: int, centre: float, count: int, labels: Bool[np.ndarray, "i j k"]) -> Grid:
    affine, first = grid.affine.astype(float).copy(), np.zeros((1, 3))
    first[0, axis] = centre
    affine[:3, 3] = grid.to_world(first)[0]
    affine[:3, axis] *= count
    return Grid((labels.shape[0], labels.shape[1], labels.shape[2]), affine)


def measure(model: ShapeModel, case: Case, rule: ThickRule, count: int) -> Answer | None:
    """The answer to a drawing; None where that has a single plane."""
    stack, planes = drawn_by(rule, case, count)
    if len(planes) < LEAST_PLANES:
        return None
    found = reconstruct(model, [stack], Options(annotated=planes))
    filled = body_mask(model, found.state, found.mesh, case.grid)
    volume, truth = found.volume_ml, case.volume_ml
    return Answer(
        agreement(case.mask, filled, case.grid.spacing).asd_mm,
        volume.value / truth - 1.0,
        bool((volume.low or 0.0) <= truth <= (volume.high or 0.0)),
        found.state.fits[0].thick_rule,
    )


def _line(answers: list[Answer]) -> str:
    errors = np.array([one.volume_error for one in answers])
    held = np.mean([one.is_held for one in answers])
    taken = ", ".join(
        f"{rule} {share:.0%}"
        for rule in get_args(ThickRule)
        if (share := np.mean([one.rule == rule for one in answers])) > 0
    )
    asd = np.mean([one.asd_mm for one in answers])
    return f"{asd:8.3f}{errors.mean():+10.1%}{np.abs(errors).mean():10.1%}{held:8.0%}  {taken}"


def main(
    model: Annotated[str, typer.Option(help="Name of a shipped model, or the folder of a bundle.")] = "hippocampus",
    cohort: Annotated[CohortName, typer.Option(help="Cohort of the model.")] = CohortName.HIPPOCAMPUS,
    data: DataOption = None,
    cases: Annotated[int, typer.Option(min=1, max=200, help="Validation cases, at most.")] = 18,
) -> None:
    """Accuracy from thick slices by what they were drawn by."""
    with exit_status():
        opened = open_bundle(find_bundle(model, [shipped_bundles()]))
        found = load_cohort(cohort, data_folder(data), CohortOptions(skip_refused=True))
    typer.echo(f"{'voxels':7}{'foreground by':16}{'ASD mm':>8}{'volume':>10}{'|volume|':>10}{'held':>8}  taken for")
    for count in THICKNESSES:
        for rule in ("at least half", "more than half", "section") if count % 2 == 0 else ("half", "section"):
            answers = [measure(opened, case, rule, count) for case in evenly(found.validation, cases)]
            typer.echo(f"{count:<7}{rule:16}{_line([one for one in answers if one is not None])}")


if __name__ == "__main__":
    typer.run(main)
