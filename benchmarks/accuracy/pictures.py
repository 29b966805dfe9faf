"""Pictures of the best, median and worst case: the truth with what was drawn, and the reconstruction's error."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from skimage import measure

from benchmarks.accuracy.cells import Cell
from benchmarks.accuracy.drawings import DrawingName, draw
from benchmarks.accuracy.names import MethodName
from model.bundle import ShapeModel
from model.geometry import Grid
from model.inference.mask_stack import Plane, section_of
from model.inference.reconstruction import Options, reconstruct
from training.cohorts.cohort import Case
from training.oblique import SliceStacks
from training.rendering import STEPS, TRUTH_COLOUR, Surface, axes_around, show, surface_error, truth_surface

#: Errors are coloured up to this many times the case's average surface distance.
SCALE = 4.0
CONTOUR_COLOUR = "#c2185b"


@dataclass(frozen=True)
class Choice:
    """A case to show, why, and its average surface distance (mm)."""

    words: str
    case: str
    asd_mm: float


def best_median_worst(cells: Iterable[Cell], drawing: DrawingName) -> list[Choice]:
    """Cases of one cohort by the project's average surface distance; fewer when there are fewer cases."""
    mine = [cell for cell in cells if (cell.key.method, cell.key.drawing) == (MethodName.PROJECT, drawing)]
    ordered = sorted((cell for cell in mine if cell.measured), key=lambda cell: cell.asd_mm)
    places = {"best": 0, "median": len(ordered) // 2, "worst": len(ordered) - 1} if ordered else {}
    found: dict[str, Choice] = {}
    for words, place in places.items():
        found.setdefault(ordered[place].key.case, Choice(words, ordered[place].key.case, ordered[place].asd_mm))
    return list(found.values())


def save_picture(
    model: ShapeModel, cases: Sequence[Case], choices: Sequence[Choice], drawing: DrawingName, path: Path
) -> None:
    """One row a choice; written as PNG."""
    named = {case.name: case for case in cases}
    figure = Figure(figsize=(7.0, 3.1 * len(choices)), layout="constrained")
    for row, choice in enumerate(choices):
        case = named[choice.case]
        drawn = draw(case, drawing)
        truth, found = truth_surface(case), reconstructed(model, drawn)
        world = case.grid.to_world(np.argwhere(case.mask).astype(float))
        left, right = (axes_around(figure, (len(choices), 2, 2 * row + column), world) for column in (1, 2))
        show(left, truth, TRUTH_COLOUR)
        left.add_collection3d(Line3DCollection(contours(drawn), colors=CONTOUR_COLOUR, linewidths=1.2))
        left.set_title(f"{choice.words}: truth and what was drawn", fontsize=9)
        scale = Normalize(0.0, SCALE * choice.asd_mm)
        show(right, found, colormaps["viridis"](scale(surface_error(case, found)[found.faces].mean(axis=1)))[:, :3])
        right.set_title(f"reconstruction, ASD {choice.asd_mm:.2f} mm", fontsize=9)
        bar = figure.colorbar(ScalarMappable(scale, colormaps["viridis"]), ax=right, shrink=0.7)
        bar.set_label("distance to the truth (mm)", fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)


def reconstructed(model: ShapeModel, drawn: SliceStacks) -> Surface:
    """The project's surface, on a grid coarse enough to be drawn."""
    extent = float(max(model.manifest.half_extent_mm)) * 2.0
    options = Options(annotated=drawn.planes, uncertainty="none", resolution_mm=max(1.0, extent / STEPS))
    mesh = reconstruct(model, drawn.stacks, options).mesh
    return Surface(mesh.vertices, np.asarray(mesh.faces))


def contours(drawn: SliceStacks) -> list[Float[np.ndarray, "n 3"]]:
    """Outlines of the drawn sections in the world (mm)."""
    found: list[Float[np.ndarray, "n 3"]] = []
    for plane in drawn.planes:
        stack = drawn.stacks[plane.stack]
        found += _outlines(section_of(stack.foreground, plane), plane, stack.grid)
    return found


def _outlines(section: Bool[np.ndarray, "a b"], plane: Plane, grid: Grid) -> list[Float[np.ndarray, "n 3"]]:
    library: Any = measure
    lines = library.find_contours(np.pad(section, 1).astype(float), 0.5)
    return [grid.to_world(np.insert(line - 1.0, plane.axis, float(plane.index), axis=1)) for line in lines]
