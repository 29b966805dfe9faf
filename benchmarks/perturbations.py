"""``python -m benchmarks.perturbations``: accuracy from drawings as they come in practice beside undisturbed ones.

For each case and perturbation: average surface distance against the dense mask, its ratio to that of the undisturbed
drawing, and whether the answer says that it is not reliable.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from model.bundle import ShapeModel, open_bundle
from model.errors import InputError
from model.geometry import Grid
from model.inference.fitting import MirrorRule
from model.inference.one_body import body_mask
from model.inference.reconstruction import Options, reconstruct
from training.cohort_options import DataOption
from training.cohorts import Case, CohortName, CohortOptions, data_folder, load_cohort
from training.console import exit_status
from training.evaluate import find_bundle, shipped_bundles
from training.metrics_masks import agreement
from training.perturb import (
    WRONG_KINDS,
    Sections,
    WrongKind,
    cut_off,
    moved,
    noisy,
    oblique,
    one_end,
    parallel,
    sections_of,
    tilted,
    with_wrong,
)
from training.sparsify import for_evaluation

OFFSET_MM = (20.0, -20.0, 20.0)
TURN_DEGREES = 20.0
TILTS_DEGREES = (15.0, 30.0, 45.0)
#: A perturbation is borne when the mean distance stays within this factor.
BORNE = 1.05


@dataclass(frozen=True)
class Scene:
    """What a perturbation may use: a case, another one, chance."""

    case: Case
    other: Case
    rng: np.random.Generator


@dataclass(frozen=True)
class Perturbation:
    """A disturbed drawing beside the undisturbed one.

    Attributes:
        name: in the table.
        plain, disturbed: the drawings.
        affine: from the case's world to that of the disturbed drawing (RAS mm).
        mirror: what the fit is told.
    """

    name: str
    plain: Callable[[Scene], Sections]
    disturbed: Callable[[Scene], Sections]
    affine: Float[np.ndarray, "4 4"]
    mirror: MirrorRule = "never"


@dataclass(frozen=True)
class Outcome:
    """Average surface distance (mm) and warnings; infinite and the reason where the drawing was refused."""

    asd_mm: float
    warnings: tuple[str, ...]


#: Outcomes of undisturbed drawings, by the drawing and the number of the case.
Known = dict[tuple[Callable[[Scene], Sections], int], Outcome]


def perturbations() -> Iterator[Perturbation]:
    """All of them."""
    here = np.eye(4)
    yield Perturbation("annotator noise", five, lambda s: noisy(five(s), s.rng), here)
    yield Perturbation("annotator noise, orthogonal", orthogonal, lambda s: noisy(orthogonal(s), s.rng), here)
    yield Perturbation("planes end inside the object", five, lambda s: cut_off(five(s)), here)
    yield Perturbation("planes end inside, orthogonal", orthogonal, lambda s: cut_off(orthogonal(s)), here)
    yield Perturbation("thick slices", _regime("thin"), _regime("thick"), here)
    for degrees in TILTS_DEGREES:
        yield Perturbation(f"slices leaning by {degrees:g} degrees", five, _leaning(degrees), here)
    yield Perturbation("five oblique planes", five, lambda s: oblique(s.case, 5), here)
    yield Perturbation("one end only", five, lambda s: one_end(s.case.mask, s.case.grid), here)
    for kind in WRONG_KINDS:
        yield Perturbation(f"one of five wrong: {kind}", five, _wrong(kind), here)
    yield _elsewhere("20 mm off", np.eye(3), OFFSET_MM)
    for axis, name in enumerate("RAS"):
        turn = Rotation.from_rotvec(np.radians(TURN_DEGREES) * np.eye(3)[axis]).as_matrix()
        yield _elsewhere(f"20 degrees about {name}", turn, (0.0, 0.0, 0.0))
    yield _elsewhere("left for right", np.diag([-1.0, 1.0, 1.0]), (0.0, 0.0, 0.0), "auto")


def five(scene: Scene) -> Sections:
    """Five parallel slices."""
    return parallel(scene.case.mask, scene.case.grid)


def orthogonal(scene: Scene) -> Sections:
    """The largest slice in each plane."""
    return _regime("orthogonal")(scene)


def _regime(name: str) -> Callable[[Scene], Sections]:
    def drawn(scene: Scene) -> Sections:
        match name:
            case "thin" | "thick" | "orthogonal":
                return sections_of(for_evaluation(scene.case.mask, scene.case.grid, name))
            case _:
                raise ValueError(name)

    return drawn


def _leaning(degrees: float) -> Callable[[Scene], Sections]:
    return lambda scene: tilted(scene.case, degrees)


def _wrong(kind: WrongKind) -> Callable[[Scene], Sections]:
    def drawn(scene: Scene) -> Sections:
        clean, other = five(scene), parallel(scene.other.mask, scene.other.grid)
        return with_wrong(clean, int(scene.rng.integers(len(clean.stacks))), kind, scene.rng, other)

    return drawn


def _elsewhere(
    name: str, linear: Float[np.ndarray, "3 3"], offset: tuple[float, float, float], mirror: MirrorRule = "never"
) -> Perturbation:
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = linear, offset
    return Perturbation(name, orthogonal, lambda scene: moved(orthogonal(scene), affine), affine, mirror)


def measure(
    model: ShapeModel, case: Case, drawing: Sections, affine: Float[np.ndarray, "4 4"], mirror: MirrorRule
) -> Outcome:
    """A drawing's reconstruction against the dense mask in the drawing's world."""
    try:
        answer = reconstruct(model, drawing.stacks, Options(annotated=drawing.planes, mirror=mirror))
    except InputError as error:
        return Outcome(np.inf, (str(error),))
    there = Grid(case.grid.shape, affine @ case.grid.affine)
    filled = body_mask(model, answer.state, answer.mesh, there)
    return Outcome(agreement(case.mask, filled, there.spacing).asd_mm, answer.warnings)


def line(model: ShapeModel, cases: Sequence[Case], perturbation: Perturbation, known: Known) -> str:
    """A row of the table; outcomes of undisturbed drawings are kept in `known`."""
    pairs = [_pair(model, cases, number, perturbation, known) for number in range(len(cases))]
    plain, disturbed = ([pair[side].asd_mm for pair in pairs] for side in (0, 1))
    warned = np.array([bool(pair[1].warnings) for pair in pairs])
    borne = np.array(disturbed) <= BORNE * np.array(plain)
    falsely = np.mean([bool(pair[0].warnings) for pair in pairs])
    ratio = np.mean(disturbed) / np.mean(plain)
    return (
        f"{perturbation.name:32}{np.mean(plain):9.3f}{np.mean(disturbed):10.3f}{ratio:8.2f}"
        f"{warned.mean():9.0%}{(borne | warned).mean():17.0%}{falsely:15.0%}"
    )


def _pair(
    model: ShapeModel, cases: Sequence[Case], number: int, perturbation: Perturbation, known: Known
) -> tuple[Outcome, Outcome]:
    scene = Scene(cases[number], cases[(number + 1) % len(cases)], np.random.default_rng(number))
    key = perturbation.plain, number
    if key not in known:
        known[key] = measure(model, scene.case, perturbation.plain(scene), np.eye(4), "never")
    disturbed = perturbation.disturbed(scene)
    return known[key], measure(model, scene.case, disturbed, perturbation.affine, perturbation.mirror)


def main(
    model: Annotated[str, typer.Option(help="Name of a shipped model, or the folder of a bundle.")] = "hippocampus",
    cohort: Annotated[CohortName, typer.Option(help="Cohort of the model.")] = CohortName.HIPPOCAMPUS,
    data: DataOption = None,
    cases: Annotated[int, typer.Option(min=1, max=200, help="Cases, at most.")] = 30,
    validation: Annotated[bool, typer.Option(help="Validation cases in place of test cases.")] = False,
) -> None:
    """Accuracy from disturbed drawings."""
    with exit_status():
        opened = open_bundle(find_bundle(model, [shipped_bundles()]))
        found = load_cohort(cohort, data_folder(data), CohortOptions(skip_refused=True))
    chosen = (found.validation if validation else found.test)[:cases]
    heads = ("ASD mm", "disturbed", "ratio", "warned", "borne or warned", "warned before")
    widths = (9, 10, 8, 9, 17, 15)
    typer.echo(f"{'perturbation':32}" + "".join(f"{head:>{width}}" for head, width in zip(heads, widths, strict=True)))
    known: Known = {}
    for perturbation in perturbations():
        typer.echo(line(opened, chosen, perturbation, known))


if __name__ == "__main__":
    typer.run(main)
