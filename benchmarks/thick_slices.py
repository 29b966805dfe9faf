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
from model.inference.fit_types import ThickRule
from model.inference.mask_stack import MaskStack, Plane
from model.inference.one_body import body_mask
from model.inference.reconstruction import Options, reconstruct
from training.answerable import LEAST_PLANES
from training.cohort_options import DataOption
from training.cohorts import CohortName, CohortOptions, data_folder, load_cohort
from training.cohorts.cohort import Case, evenly
from training.console import exit_status
from training.evaluate import find_bundle, shipped_bundles
from training.metrics_masks import agreement
from training.oblique import SliceStacks
from training.sparsify import blocks_of, body_axes, centred_block, centred_offset, thick_grid

THICKNESSES = (4, 5, 8)


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


def drawn_by(rule: ThickRule, case: Case, count: int) -> SliceStacks:
    """A case on axial slices of so many voxels' thickness, centred in the object, and those that show some of it."""
    axial, middle = body_axes(case.grid)[2], count // 2
    is_section = rule == "section"
    first = centred_offset(case.mask, axial, count) - middle if is_section else centred_block(case.mask, axial, count)
    start, fine = blocks_of(case.mask, axial, first, count)
    labels = fine[:, middle] if is_section else _filled(fine.mean(axis=1), rule)
    # A thick slice stands at the centre of its block, a section where it was taken.
    begins = start + (middle - (count - 1) / 2 if is_section else 0.0)
    shown = np.flatnonzero(labels.any(axis=(1, 2)))
    labels = np.moveaxis(labels, 0, axial)
    stack = MaskStack("mask[0]", thick_grid(case.grid, axial, begins, count, len(fine)), labels, np.zeros_like(labels))
    return SliceStacks((stack,), tuple(Plane(0, axial, int(index)) for index in shown))


def _filled(share: Float[np.ndarray, "n a b"], rule: ThickRule) -> Bool[np.ndarray, "n a b"]:
    return share > 0.5 if rule == "more than half" else share >= 0.5


def measure(model: ShapeModel, case: Case, rule: ThickRule, count: int) -> Answer | None:
    """The answer to a drawing; None where that has a single plane."""
    drawing = drawn_by(rule, case, count)
    if len(drawing.planes) < LEAST_PLANES:
        return None
    found = reconstruct(model, drawing.stacks, Options(annotated=drawing.planes))
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
