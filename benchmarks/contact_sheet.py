"""``python -m benchmarks.contact_sheet``: draws of a model, or its first modes, rendered to one PNG to be looked at."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from model.bundle import ShapeModel
from model.errors import InputError, NotFound
from model.inference.mesh import Mesh
from model.inference.modes import DISPLACEMENT, shape_along, shape_modes
from model.inference.sampling import draw_shape
from training.evaluate import open_named

LIGHT = np.array([0.3, -0.8, 0.5]) / np.linalg.norm([0.3, -0.8, 0.5])
ELEVATION, AZIMUTH = np.deg2rad(20.0), np.deg2rad(-60.0)
COLOUR = (0.86, 0.70, 0.60)
#: Standard deviations at which modes are shown.
STOPS = (-2.0, -1.0, 0.0, 1.0, 2.0)
#: Size of a cell (inches).
CELL = 1.3


def main(
    model: Annotated[str, typer.Option(help="Name of a shipped model, or the folder of a bundle.")],
    output: Annotated[Path, typer.Option(help="PNG to write.")],
    count: Annotated[int, typer.Option(min=1, max=400, help="Draws.")] = 64,
    modes: Annotated[int, typer.Option(min=0, help="Show so many modes in place of draws.")] = 0,
    spacing_mm: Annotated[float | None, typer.Option(help="Grid step (mm); 1.5 times the model's.")] = None,
    reject: Annotated[bool, typer.Option("--reject/--no-reject", help="Draw anew where implausible.")] = True,
) -> None:
    """Render a contact sheet."""
    try:
        opened = open_named(model)
        step = spacing_mm or 1.5 * opened.manifest.resolution_mm
        if modes:
            save_modes(opened, modes, step, output)
        else:
            save_draws(opened, count, step, output, reject=reject)
    except (InputError, NotFound) as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from error


def save_draws(model: ShapeModel, count: int, spacing_mm: float, output: Path, *, reject: bool) -> None:
    """Draws of seeds 0, 1, ... row by row, all at one scale."""
    shapes = [draw_shape(model, seed, spacing_mm=spacing_mm, reject=reject).mesh for seed in range(count)]
    columns = int(np.ceil(np.sqrt(count)))
    _save([(f"{seed}", mesh, None) for seed, mesh in enumerate(shapes)], columns, _title(model), output)


def save_modes(model: ShapeModel, count: int, spacing_mm: float, output: Path) -> None:
    """One row a mode from -2 to 2 SD, coloured by what one more SD moves out (red) and in (blue)."""
    found = shape_modes(model)
    cells = []
    for mode in found.ranked[:count]:
        meshes = [shape_along(model, found, {mode.rank: sd}, spacing_mm) for sd in STOPS]
        top = max(float(np.abs(mesh.scalars[DISPLACEMENT]).max()) for mesh in meshes)
        for sd, mesh in zip(STOPS, meshes, strict=True):
            values = mesh.scalars[DISPLACEMENT][mesh.faces].mean(axis=1)
            shares = f"mode {mode.rank} ({mode.variance_explained:.0%})" if sd == STOPS[0] else ""
            cells.append((f"{shares} {sd:+g} SD", mesh, colormaps["RdBu_r"](0.5 + 0.5 * values / top)[:, :3]))
    _save(cells, len(STOPS), _title(model) + ", modes", output)


def _title(model: ShapeModel) -> str:
    return f"{model.manifest.name} {model.manifest.version}"


def _save(
    cells: Sequence[tuple[str, Mesh, Float[np.ndarray, "f 3"] | None]], columns: int, title: str, output: Path
) -> None:
    rows = -(-len(cells) // columns)
    figure = Figure(figsize=(CELL * columns, CELL * rows + 0.3), layout="constrained")
    figure.suptitle(title, fontsize=9)
    half = max(float(np.abs(_projected(mesh)[0]).max()) for _, mesh, _ in cells if not mesh.is_empty)
    for place, (words, mesh, colours) in enumerate(cells, start=1):
        axes = figure.add_subplot(rows, columns, place)
        axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")
        axes.set_axis_off()
        axes.set_title(words, fontsize=6, pad=1)
        if not mesh.is_empty:
            axes.add_collection(_drawn(mesh, colours))
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=110)


def _projected(mesh: Mesh) -> tuple[Float[np.ndarray, "v 2"], Float[np.ndarray, "v"]]:
    """Vertices on the picture around its middle (mm), and their depth towards the viewer."""
    to_viewer = np.array([np.cos(ELEVATION) * np.cos(AZIMUTH), np.cos(ELEVATION) * np.sin(AZIMUTH), np.sin(ELEVATION)])
    right = np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0])
    centred = mesh.vertices - (mesh.vertices.max(axis=0) + mesh.vertices.min(axis=0)) / 2.0
    flat = np.stack([centred @ right, centred @ np.cross(to_viewer, right)], axis=1)
    return flat, centred @ to_viewer


def _drawn(mesh: Mesh, colours: Float[np.ndarray, "f 3"] | None) -> PolyCollection:
    """Triangles from the farthest to the nearest, with plain shading."""
    flat, depth = _projected(mesh)
    order = np.argsort(depth[mesh.faces].mean(axis=1))
    light = 0.45 + 0.55 * np.abs(mesh.normals[mesh.faces].mean(axis=1) @ LIGHT)
    base = np.broadcast_to(COLOUR, (len(mesh.faces), 3)) if colours is None else colours
    shaded = np.clip(base * light[:, None], 0.0, 1.0)[order]
    return PolyCollection(list(flat[mesh.faces][order]), facecolors=shaded, edgecolors=shaded, linewidths=0.2)


if __name__ == "__main__":
    typer.run(main)
