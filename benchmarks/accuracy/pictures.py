"""Pictures of the best, median and worst case: the truth with what was drawn, and the reconstruction's error."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from scipy.ndimage import map_coordinates
from skimage import measure

from benchmarks.accuracy.cells import Cell
from benchmarks.accuracy.drawings import DrawingName, draw
from benchmarks.accuracy.names import MethodName
from model.bundle import ShapeModel
from model.geometry import Grid
from model.inference.mask_stack import Plane, section_of
from model.inference.reconstruction import Options, reconstruct
from training.baselines.distance import signed_distance
from training.cohorts.cohort import Case
from training.oblique import SliceStacks

#: Errors are coloured up to this many times the case's average surface distance.
SCALE = 4.0
#: Largest number of grid steps along a drawn surface, which keeps the number of triangles down.
STEPS = 60
LIGHT = np.array([0.3, -0.8, 0.5])
ELEVATION, AZIMUTH = 20.0, -60.0
CONTOUR_COLOUR, TRUTH_COLOUR = "#c2185b", (0.80, 0.82, 0.86)


@dataclass(frozen=True)
class Choice:
    """A case to show, why, and its average surface distance (mm)."""

    words: str
    case: str
    asd_mm: float


@dataclass(frozen=True)
class Surface:
    """Triangles in the world (mm)."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


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
        left, right = (_axes(figure, len(choices), 2 * row + column, case) for column in (1, 2))
        _show(left, truth, TRUTH_COLOUR)
        left.add_collection3d(Line3DCollection(contours(drawn), colors=CONTOUR_COLOUR, linewidths=1.2))
        left.set_title(f"{choice.words}: truth and what was drawn", fontsize=9)
        scale = Normalize(0.0, SCALE * choice.asd_mm)
        _show(right, found, colormaps["viridis"](scale(surface_error(case, found)[found.faces].mean(axis=1)))[:, :3])
        right.set_title(f"reconstruction, ASD {choice.asd_mm:.2f} mm", fontsize=9)
        bar = figure.colorbar(ScalarMappable(scale, colormaps["viridis"]), ax=right, shrink=0.7)
        bar.set_label("distance to the truth (mm)", fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)


def truth_surface(case: Case) -> Surface:
    """Surface of a dense mask."""
    padded = np.pad(case.mask, 1).astype(np.float32)
    step = max(1, round(max(case.mask.shape) / STEPS))
    library: Any = measure
    vertices, faces, _, _ = library.marching_cubes(padded, 0.5, step_size=step)
    return Surface(case.grid.to_world(vertices - 1.0), np.asarray(faces, np.int64))


def reconstructed(model: ShapeModel, drawn: SliceStacks) -> Surface:
    """The project's surface, on a grid coarse enough to be drawn."""
    extent = float(max(model.manifest.half_extent_mm)) * 2.0
    options = Options(annotated=drawn.planes, uncertainty="none", resolution_mm=max(1.0, extent / STEPS))
    mesh = reconstruct(model, drawn.stacks, options).mesh
    return Surface(mesh.vertices, np.asarray(mesh.faces))


def surface_error(case: Case, surface: Surface) -> Float[np.ndarray, "v"]:
    """Distance (mm) of each vertex to the surface of a dense mask, from its distance field."""
    room = 8
    field = signed_distance(np.pad(case.mask, room), case.grid.spacing)
    index = case.grid.to_index(surface.vertices) + room
    return np.asarray(np.abs(map_coordinates(field, index.T, order=1, mode="nearest")))


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


def _axes(figure: Figure, rows: int, position: int, case: Case) -> Any:
    """An empty 3-D view, its limits those of the case."""
    axes: Any = figure.add_subplot(rows, 2, position, projection="3d")
    world = case.grid.to_world(np.argwhere(case.mask).astype(float))
    middle, half = (world.max(axis=0) + world.min(axis=0)) / 2.0, np.ptp(world, axis=0).max() / 2.0
    for set_limits, centre in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), middle, strict=True):
        set_limits(centre - half, centre + half)
    axes.set_box_aspect((1, 1, 1), zoom=1.4)
    axes.view_init(ELEVATION, AZIMUTH)
    axes.set_axis_off()
    axes.computed_zorder = False
    return axes


def _show(axes: Any, surface: Surface, colours: Any) -> None:
    """Triangles with plain shading."""
    corners = surface.vertices[surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    light = 0.45 + 0.55 * np.abs(across / lengths @ (LIGHT / np.linalg.norm(LIGHT)))
    shaded = np.broadcast_to(np.asarray(colours), (len(corners), 3)) * light[:, None]
    axes.add_collection3d(
        Poly3DCollection(corners, facecolors=np.clip(shaded, 0.0, 1.0), linewidths=0, antialiased=False)
    )
