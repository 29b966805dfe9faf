"""The commands ``reconstruct``, ``sample`` and ``models``: the use cases without HTTP."""

import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from model.bundle import ShapeModel
from model.errors import InvalidParameter
from model.inference.calipers import USUAL_TEXT, parse_extents
from model.inference.decimation import decimated
from model.inference.fitting import MirrorRule
from model.inference.observations import MaskStack
from model.inference.reconstruction import Options, UncertaintyRule
from service import use_cases
from service.adapters.images import write_nifti
from service.adapters.mesh_formats import write_mesh
from service.adapters.processes import spread
from service.adapters.sample_files import MANIFEST, Draw, SampleFile, SampleWriter, make_sample, manifest_bytes
from service.console import echo_json, in_order, progress, require_free, require_suffix, writing
from service.model_registry import ModelRegistry, load_registry
from service.ports import Compute, MeshFormat, Outcome, SampleFormat
from service.presentation import model_summary, summary_of
from service.provenance import metadata_of
from service.request_schemas import parse_annotated, parse_labels
from service.schemas import EstimateSchema, ModelList, Summary
from service.settings import Settings, load_settings
from service.wiring import mask_reader

#: Suffix of volumes that commands write.
NIFTI_SUFFIX = "nii.gz"
#: Steps of a reconstruction that a progress bar counts: masks, then the four stages.
STEPS = 5

#: Finds the models that the settings ask for; the application carries it to its commands.
OpenRegistry = Callable[[Settings], ModelRegistry]
#: A helper takes as long to start as some dozen shapes take to draw.
SHAPES_FOR_HELPER = 32

ModelOption = Annotated[str | None, typer.Option(help="Model name; may be left out when only one is loaded.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]
FidelityOption = Annotated[
    float | None, typer.Option(min=0.0, max=1.0, help="0 trusts the model, 1 the slices; the model's when left out.")
]
ExtentsOption = Annotated[
    str, typer.Option(help="R, A, S, longest, or directions such as 0.5 0 0.87, separated by commas.")
]
RejectOption = Annotated[bool, typer.Option("--reject/--no-reject", help="Draw anew where a shape is implausible.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Overwrite files that exist.")]


def reconstruct(
    context: typer.Context,
    masks: Annotated[list[Path], typer.Argument(metavar="MASK...", help="Sparse segmentations of one object.")],
    model: ModelOption = None,
    label: Annotated[list[str] | None, typer.Option(help="Label value or values; all non-zero when left out.")] = None,
    annotated: Annotated[str, typer.Option(help="auto, all, nonempty, or a JSON list of planes.")] = "auto",
    uncertainty: Annotated[UncertaintyRule, typer.Option(help="How uncertainty is found.")] = "laplace",
    mirror: Annotated[MirrorRule, typer.Option(help="Whether left and right are exchanged.")] = "never",
    resolution_mm: Annotated[float | None, typer.Option(help="Grid step of the surface (mm).")] = None,
    seed: Annotated[int, typer.Option(min=0, max=use_cases.MAX_SEED, help="Makes the answer repeatable.")] = 0,
    fidelity: FidelityOption = None,
    extents: ExtentsOption = USUAL_TEXT,
    output: Annotated[Path | None, typer.Option(help="Surface to write; its suffix says the format.")] = None,
    max_error_mm: Annotated[
        float, typer.Option(min=0.0, max=10.0, help="Write fewer triangles, at most this far (mm) from the surface.")
    ] = 0.0,
    segmentation: Annotated[Path | None, typer.Option(help="Label map to write (.nii.gz).")] = None,
    entropy: Annotated[Path | None, typer.Option(help="Voxel entropy to write (.nii.gz).")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Reconstruct a surface from sparse masks."""
    targets = {"--output": output, "--segmentation": segmentation, "--entropy": entropy}
    format = require_suffix("--output", output, tuple(MeshFormat))
    for option, path in list(targets.items())[1:]:
        require_suffix(option, path, (NIFTI_SUFFIX,))
    require_free(targets, force=force)
    if entropy is not None and uncertainty == "none":
        raise InvalidParameter("--entropy needs --uncertainty laplace or ensemble.", part="--entropy")
    settings = load_settings()
    registry = context.obj(settings)
    choices = uncertainty, mirror, resolution_mm, seed, fidelity, parse_extents(extents)
    options = Options(parse_annotated(annotated), *choices)
    with progress(STEPS) as watch:
        watch("masks")
        stacks = _read(settings, masks, parse_labels(label or []))
        outcome = use_cases.reconstruct(registry.get(model), stacks, options, settings.max_voxels, watch)
        with writing("--output"):
            _write_mesh(outcome, output, format, max_error_mm)
        with writing("--segmentation"):
            _write_volume(registry, outcome, segmentation, use_cases.segmentation, settings.max_voxels)
        with writing("--entropy"):
            _write_volume(registry, outcome, entropy, use_cases.entropy_map, settings.max_voxels)
    summary = summary_of(outcome)
    echo_json(summary) if as_json else typer.echo(_sentences(summary))


def sample(
    context: typer.Context,
    output: Annotated[Path, typer.Option(help="Folder, or a file that ends with .zip.")],
    model: ModelOption = None,
    count: Annotated[int, typer.Option(help="How many.")] = 16,
    seed: Annotated[int, typer.Option(help="Seed of the first one; the next one's is one more.")] = 0,
    format: Annotated[SampleFormat, typer.Option(help="File format.")] = SampleFormat.STL,
    temperature: Annotated[float, typer.Option(help="Spread of the shapes; 1 is the population's.")] = 1.0,
    spacing_mm: Annotated[float | None, typer.Option(help="Grid step (mm); the model's when left out.")] = None,
    reject: RejectOption = True,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Draw synthetic shapes from a model."""
    settings = load_settings()
    chosen = context.obj(settings).get(model)
    seeds = use_cases.batch_seeds(seed, count, use_cases.MAX_SEED)
    how = Draw(format, temperature, spacing_mm, settings.max_voxels, reject)
    helpers = min(settings.workers - 1, count // SHAPES_FOR_HELPER)
    with spread(helpers, partial(load_registry, settings)) as compute, writing("--output"):
        batch = _Batch(chosen, seeds, how, compute, helpers + 1)
        if output.suffix.lower() == ".zip":
            require_free({"--output": output}, force=force)
            manifest = _sample_to_zip(batch, output)
        else:
            manifest = _sample_to_folder(batch, output, force=force)
    typer.echo(
        manifest.decode()
        if as_json
        else f"{count} {'shape' if count == 1 else 'shapes'} of {chosen.manifest.name} written."
    )


def models(context: typer.Context, as_json: JsonOption = False) -> None:
    """List the models."""
    registry = context.obj(load_settings())
    loaded = [model_summary(model, f"/v1/models/{model.manifest.name}") for model in use_cases.describe(registry)]
    if as_json:
        echo_json(ModelList(models=loaded))
    else:
        table = Table("name", "version", "structure", "digest")
        for model in loaded:
            table.add_row(model.name, model.version, model.structure, model.digest[:12])
        Console().print(table)
    for broken in registry.broken:
        typer.echo(f"{broken.name} is not loaded: {broken.reason}", err=True)


def _read(settings: Settings, masks: list[Path], labels: frozenset[int] | None) -> tuple[MaskStack, ...]:
    for number, path in enumerate(masks):
        if not path.is_file():
            raise InvalidParameter(f"Each MASK must be a file; there is no file {path}.", part=f"mask[{number}]")
    return use_cases.stacks_of(mask_reader(settings), masks, labels, settings.max_voxels)


def _write_mesh(outcome: Outcome, path: Path | None, format: str, max_error_mm: float) -> None:
    if path is None:
        return
    mesh = decimated(outcome.reconstruction.mesh, max_error_mm)
    path.write_bytes(write_mesh(mesh, format, space=outcome.reconstruction.space, metadata=metadata_of(outcome)))


def _write_volume(
    registry: ModelRegistry,
    outcome: Outcome,
    path: Path | None,
    compute: Callable[..., use_cases.Volume],
    max_voxels: int,
) -> None:
    if path is None:
        return
    volume = compute(registry, outcome, None, max_voxels)
    path.write_bytes(write_nifti(volume.array, volume.grid, compute.__name__.replace("_", " ")))


@dataclass(frozen=True)
class _Batch:
    """Shapes to be drawn, so many at the same time."""

    model: ShapeModel
    seeds: range
    how: Draw
    compute: Compute
    workers: int

    def write(self, put: Callable[[SampleFile], object]) -> bytes:
        """Put every shape's file, in order; the manifest of all."""
        writer, entries = SampleWriter(write_mesh, write_nifti), []

        def make(seed: int) -> SampleFile:
            return self.compute(make_sample, self.model, writer, seed, self.how)

        with progress(len(self.seeds)) as step:
            for seed, file in zip(self.seeds, in_order(make, self.seeds, self.workers), strict=True):
                step(f"seed {seed}")
                put(file)
                entries.append(file.entry)
        return manifest_bytes(self.model, self.how, entries)


def _sample_to_zip(batch: _Batch, target: Path) -> bytes:
    with zipfile.ZipFile(target, "w") as archive:
        manifest = batch.write(lambda file: archive.writestr(file.name, file.data))
        archive.writestr(MANIFEST, manifest)
    return manifest


def _sample_to_folder(batch: _Batch, target: Path, *, force: bool) -> bytes:
    if target.exists() and not target.is_dir():
        raise InvalidParameter("--output must be a folder or end with .zip.", part="--output")
    if not force and target.is_dir() and any(target.iterdir()):
        raise InvalidParameter("--output names a folder that is not empty; --force writes into it.", part="--output")
    target.mkdir(parents=True, exist_ok=True)
    manifest = batch.write(lambda file: (target / file.name).write_bytes(file.data))
    (target / MANIFEST).write_bytes(manifest)
    return manifest


def _sentences(summary: Summary) -> str:
    fit = summary.fit
    lines = [
        f"{summary.model.name} {summary.model.version}: {fit.message} ({fit.iterations} iterations)",
        f"volume {_figure(summary.volume_ml)} mL, surface area {_figure(summary.area_cm2)} cm^2",
        *(f"extent {one.along}: {_figure(one.extent_mm)} mm" for one in summary.extents),
        f"typicality: percentile {summary.typicality_percentile:.0f} of the training population",
    ]
    if summary.surface_sd is not None:
        lines.append(f"surface SD {summary.surface_sd.mean_mm:.2f} mm (most {summary.surface_sd.max_mm:.2f} mm)")
    return "\n".join([*lines, *(f"warning: {warning}" for warning in summary.warnings)])


def _figure(estimate: EstimateSchema) -> str:
    if estimate.low is None or estimate.high is None:
        return f"{estimate.value:.2f}"
    return f"{estimate.value:.2f} (90 %: {estimate.low:.2f} to {estimate.high:.2f})"
