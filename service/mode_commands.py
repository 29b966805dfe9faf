"""The command ``modes``: what the dimensions of a model move, as a table and as surfaces."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from model.bundle import ShapeModel
from model.errors import InvalidParameter
from model.inference.modes import FARTHEST_SD, ShapeModes, shape_modes
from service import use_cases
from service.adapters.mesh_formats import write_mesh
from service.commands import ForceOption, JsonOption, ModelOption
from service.console import echo_json, progress, writing
from service.mode_presentation import mode_list
from service.ports import MeshFormat
from service.provenance import metadata_of
from service.settings import load_settings


def modes(
    context: typer.Context,
    model: ModelOption = None,
    count: Annotated[int, typer.Option(min=1, help="How many modes, by what they move.")] = 10,
    output: Annotated[Path | None, typer.Option(help="Folder for the mean surface and both ends of each mode.")] = None,
    sd: Annotated[float, typer.Option(min=0.0, max=FARTHEST_SD, help="How far the ends are (SD).")] = 2.0,
    format: Annotated[MeshFormat, typer.Option(help="File format.")] = MeshFormat.PLY,
    spacing_mm: Annotated[float | None, typer.Option(help="Grid step (mm); the model's when left out.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """List what the dimensions of a model move; write surfaces along them."""
    settings = load_settings()
    chosen = context.obj(settings).get(model)
    found = shape_modes(chosen)
    if output is not None:
        ends = _ends(found, count, sd)
        _write(chosen, found, ends, output, format, spacing_mm, settings.max_voxels, force=force)
    listed = mode_list(chosen, found, f"/v1/models/{chosen.manifest.name}/modes")
    if as_json:
        echo_json(listed.model_copy(update={"modes": listed.modes[:count]}))
        return
    table = Table("rank", "dimension", "sigma", "mm per SD", "variance", "cumulative")
    for mode in found.ranked[:count]:
        shares = f"{mode.variance_explained:.1%}", f"{mode.cumulative_variance:.1%}"
        table.add_row(
            str(mode.rank), str(mode.dimension), f"{mode.sigma:.3g}", f"{mode.displacement_mm_per_sd:.3f}", *shares
        )
    Console().print(table)


def _ends(found: ShapeModes, count: int, sd: float) -> dict[str, dict[int, float]]:
    """Coordinates of the mean and of both ends of the first modes, by name."""
    ends: dict[str, dict[int, float]] = {"mean": {}}
    for mode in found.ranked[:count]:
        ends[f"mode{mode.rank}-minus"] = {mode.rank: -sd}
        ends[f"mode{mode.rank}-plus"] = {mode.rank: sd}
    return ends


def _write(
    model: ShapeModel,
    found: ShapeModes,
    ends: dict[str, dict[int, float]],
    folder: Path,
    format: MeshFormat,
    spacing_mm: float | None,
    max_voxels: int,
    *,
    force: bool,
) -> None:
    manifest = model.manifest
    said = metadata_of(model)
    paths = {name: folder / f"{manifest.name}-{name}.{format.value}" for name in ends}
    _require_free(folder, paths.values(), force=force)
    with progress(len(ends)) as step:
        for name, coordinates in ends.items():
            step(name)
            mesh = use_cases.shape_along_modes(model, found, coordinates, spacing_mm, max_voxels)
            with writing("--output"):
                paths[name].write_bytes(write_mesh(mesh, format.value, space=manifest.frame, metadata=said))


def _require_free(folder: Path, paths: Iterable[Path], *, force: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise InvalidParameter("--output must be a folder.", part="--output")
    if not force and any(path.exists() for path in paths):
        raise InvalidParameter("--output holds such files already; --force overwrites them.", part="--output")
    with writing("--output"):
        folder.mkdir(parents=True, exist_ok=True)
