"""The options that say which cohort a command is about, the same for every command."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from training.cohorts import CohortName, CohortOptions
from training.cohorts.sources import CohortSource, LayoutName
from training.cohorts.voxelising import SpaceName

CohortOption = Annotated[CohortName | None, typer.Option("--cohort", help="A public cohort below the data folder.")]
MasksOption = Annotated[Path | None, typer.Option("--masks", help="A folder of NIfTI, NRRD or MetaImage masks.")]
MeshesOption = Annotated[
    Path | None, typer.Option("--meshes", help="A folder of closed meshes: STL, PLY, OBJ, VTK, VTP.")
]
LayoutOption = Annotated[LayoutName, typer.Option("--layout", help="How the masks lie in --masks.")]
LabelOption = Annotated[list[int] | None, typer.Option("--label", help="Label of the object in --masks; may repeat.")]
DataOption = Annotated[
    Path | None, typer.Option("--data", envvar="MORPHOFLOW_DATA", help="Folder that holds the public cohorts.")
]
SpacingOption = Annotated[float, typer.Option("--spacing-mm", help="Voxel size of meshes and of MedMNIST files.")]
SpaceOption = Annotated[SpaceName, typer.Option("--mesh-space", help="World of the coordinates in --meshes.")]
AlignOption = Annotated[bool, typer.Option("--align", help="Turn every shape to the mean of all.")]
TestOption = Annotated[
    float, typer.Option("--test-fraction", min=0.0, max=0.9, help="Share of persons held out where no test split is.")
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Of held-out persons, drawings and training.")]
SkipOption = Annotated[bool, typer.Option("--skip-refused", help="Go on without masks that must not be used.")]
ShippableOption = Annotated[bool, typer.Option("--shippable", help="Only masks whose licence lets weights ship.")]

Command = Callable[..., None]


def takes_cohort(command: Command) -> Command:
    """The command with these options in place of its parameters ``source`` and ``options``."""
    asked = inspect.signature(_chosen).parameters
    own = [one for name, one in inspect.signature(command).parameters.items() if name not in ("source", "options")]
    hints = get_type_hints(command, include_extras=True) | get_type_hints(_chosen, include_extras=True)
    parameters = [one.replace(annotation=hints[one.name]) for one in (*own, *asked.values())]
    signature = inspect.Signature(parameters)

    def call(*args: Any, **values: Any) -> None:
        bound = signature.bind(*args, **values)
        bound.apply_defaults()
        given = bound.arguments
        source, options = _chosen(**{name: given.pop(name) for name in asked})
        command(source=source, options=options, **given)

    call.__signature__ = signature  # type: ignore[attr-defined]
    call.__annotations__ = {one.name: one.annotation for one in parameters}
    call.__name__, call.__doc__ = command.__name__, command.__doc__
    return call


def _chosen(
    cohort: CohortOption = None,
    masks: MasksOption = None,
    meshes: MeshesOption = None,
    layout: LayoutOption = LayoutName.FOLDER,
    label: LabelOption = None,
    data: DataOption = None,
    spacing_mm: SpacingOption = 1.0,
    mesh_space: SpaceOption = SpaceName.RAS,
    align: AlignOption = False,
    test_fraction: TestOption = 0.0,
    seed: SeedOption = 0,
    skip_refused: SkipOption = False,
    shippable: ShippableOption = False,
) -> tuple[CohortSource, CohortOptions]:
    labels = tuple(label or ())
    source = CohortSource(cohort, masks, meshes, layout, labels, data, spacing_mm, mesh_space, align)
    options = CohortOptions(seed=seed, test_fraction=test_fraction, skip_refused=skip_refused, shippable_only=shippable)
    return source, options
