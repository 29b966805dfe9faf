"""The options that say which cohort a command is about, the same for every command."""

import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from model.errors import InvalidParameter
from training.cohorts import Cohort, CohortName, CohortOptions
from training.cohorts.catalogue import DATA_VARIABLE
from training.cohorts.cohort import SideName
from training.cohorts.sources import CohortSource, LayoutName, check_given, open_cohort
from training.cohorts.voxelising import SpaceName
from training.console import exit_status, progress

CohortOption = Annotated[CohortName | None, typer.Option("--cohort", help="A public cohort below the data folder.")]
MasksOption = Annotated[Path | None, typer.Option("--masks", help="A folder of NIfTI, NRRD or MetaImage masks.")]
MeshesOption = Annotated[
    Path | None, typer.Option("--meshes", help="A folder of closed meshes: STL, PLY, OBJ, VTK, VTP.")
]
LayoutOption = Annotated[
    LayoutName | None, typer.Option("--layout", help="How the masks lie in --masks; folder when left out.")
]
LabelOption = Annotated[list[int] | None, typer.Option("--label", help="Label of the object in --masks; may repeat.")]
DataOption = Annotated[
    Path | None, typer.Option("--data", envvar=DATA_VARIABLE, help="Folder that holds the public cohorts.")
]
SpacingOption = Annotated[
    float | None, typer.Option("--spacing-mm", help="Voxel size of meshes and of MedMNIST files; 1 when left out.")
]
SpaceOption = Annotated[
    SpaceName | None, typer.Option("--mesh-space", help="World of the coordinates in --meshes; RAS when left out.")
]
SideOption = Annotated[
    SideName | None, typer.Option("--side", help="Side of the shapes in --masks or --meshes; not stated when left out.")
]
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
        with exit_status():
            source, options = _chosen(**{name: given.pop(name) for name in asked})
        command(source=source, options=options, **given)

    call.__signature__ = signature  # type: ignore[attr-defined]
    call.__annotations__ = {one.name: one.annotation for one in parameters}
    call.__name__, call.__doc__ = command.__name__, command.__doc__
    return call


def require_use(source: CohortSource, options: CohortOptions) -> None:
    """Refuse options of a cohort where none was named: `InvalidParameter`."""
    if not source.is_given and (source.align or options != CohortOptions()):
        raise InvalidParameter(
            "--align, --seed, --test-fraction, --skip-refused and --shippable would do nothing here; they go with "
            "--cohort, --masks and --meshes.",
            part="cohort",
        )


def opened_cohort(source: CohortSource, options: CohortOptions) -> Cohort:
    """`open_cohort` with a bar while shapes are aligned.

    Raises:
        InvalidParameter, CohortError: see there.
    """
    if not source.align:
        return open_cohort(source, options)
    with progress(1, "aligning shapes") as bar:
        return open_cohort(
            source, options, lambda done, total: bar.update(bar.task_ids[0], completed=done, total=total)
        )


def _chosen(
    cohort: CohortOption = None,
    masks: MasksOption = None,
    meshes: MeshesOption = None,
    layout: LayoutOption = None,
    label: LabelOption = None,
    data: DataOption = None,
    spacing_mm: SpacingOption = None,
    mesh_space: SpaceOption = None,
    side: SideOption = None,
    align: AlignOption = False,
    test_fraction: TestOption = 0.0,
    seed: SeedOption = 0,
    skip_refused: SkipOption = False,
    shippable: ShippableOption = False,
) -> tuple[CohortSource, CohortOptions]:
    if cohort is None and data is not None and str(data) == os.environ.get(DATA_VARIABLE):
        data = None  # it holds for every command, also for those about other shapes
    labels = tuple(label) if label else None
    named = {
        "layout": layout,
        "labels": labels,
        "data": data,
        "spacing_mm": spacing_mm,
        "space": mesh_space,
        "side": side,
    }
    given: dict[str, Any] = {name: value for name, value in named.items() if value is not None}
    source = CohortSource(cohort, masks, meshes, align=align, **given)
    check_given(source, given)
    options = CohortOptions(seed=seed, test_fraction=test_fraction, skip_refused=skip_refused, shippable_only=shippable)
    return source, options
