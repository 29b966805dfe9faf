"""Where a cohort comes from: a public one by name, masks in one of several layouts, or meshes."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from pathlib import Path

from model.errors import InvalidParameter
from model.inference.stacks import checked_labels
from training.cohorts.assemble import CohortOptions
from training.cohorts.catalogue import CohortName, data_folder, load_cohort
from training.cohorts.cohort import Cohort, SideName
from training.cohorts.decathlon import read_decathlon
from training.cohorts.folder import read_folder
from training.cohorts.medmnist import read_medmnist
from training.cohorts.oai_zib import read_oai_zib
from training.cohorts.verse import read_verse
from training.cohorts.voxelising import SpaceName, Voxelising


class LayoutName(StrEnum):
    """How masks lie in their folder."""

    FOLDER = "folder"
    DECATHLON = "decathlon"
    MEDMNIST = "medmnist"
    VERSE = "verse"
    OAI_ZIB = "oai-zib"


@dataclass(frozen=True)
class CohortSource:
    """What was asked for; exactly one of the first three.

    Attributes:
        cohort: a public cohort below ``data``.
        masks: a folder, or the file of MedMNIST, read by ``layout``.
        meshes: a folder of closed surfaces.
        labels: of the object in label maps.
        spacing_mm: voxel size where files state none: meshes and MedMNIST.
        space: of the coordinates of meshes.
        align: whether shapes are turned to their evolving mean.
        side: of ``masks`` or ``meshes``; what their layout says, if anything, when None.
    """

    cohort: CohortName | None = None
    masks: Path | None = None
    meshes: Path | None = None
    layout: LayoutName = LayoutName.FOLDER
    labels: tuple[int, ...] = ()
    data: Path | None = None
    spacing_mm: float = 1.0
    space: SpaceName = SpaceName.RAS
    align: bool = False
    side: SideName | None = None

    @property
    def is_given(self) -> bool:
        """Whether any was asked for."""
        return any(one is not None for one in (self.cohort, self.masks, self.meshes))


#: Layouts whose files are label maps.
LABELLED = (LayoutName.FOLDER, LayoutName.DECATHLON, LayoutName.VERSE, LayoutName.OAI_ZIB)
#: Called while shapes are aligned: how many registrations are done, of how many.
Watch = Callable[[int, int], None]


@dataclass(frozen=True)
class Belonging:
    """What an option goes with.

    Attributes:
        option: as it is written.
        source: the same in words.
        holds: whether a source is that.
    """

    option: str
    source: str
    holds: Callable[[CohortSource], bool]


#: By the field of a source. Elsewhere the option would do nothing.
BELONGINGS = {
    "layout": Belonging("--layout", "--masks", lambda source: source.masks is not None),
    "labels": Belonging(
        "--label",
        "--masks of the layouts folder, decathlon, verse and oai-zib",
        lambda source: source.masks is not None and source.layout in LABELLED,
    ),
    "data": Belonging("--data", "--cohort", lambda source: source.cohort is not None),
    "spacing_mm": Belonging(
        "--spacing-mm",
        "--meshes and with --layout medmnist",
        lambda source: source.meshes is not None or (source.masks is not None and source.layout is LayoutName.MEDMNIST),
    ),
    "space": Belonging("--mesh-space", "--meshes", lambda source: source.meshes is not None),
    "side": Belonging(
        "--side", "--masks and --meshes", lambda source: source.masks is not None or source.meshes is not None
    ),
}


def check_given(source: CohortSource, given: Collection[str]) -> None:
    """Refuse options that would do nothing with a source.

    Args:
        given: fields of the source that a caller named, be it with what holds anyway.

    Raises:
        InvalidParameter: one of them does not go with the source.
    """
    for field, belonging in BELONGINGS.items():
        if field in given and not belonging.holds(source):
            option = belonging.option
            raise InvalidParameter(
                f"{option} would do nothing here; {option} goes with {belonging.source}.",
                part=option.removeprefix("--").replace("-", "_"),
            )


def open_cohort(source: CohortSource, options: CohortOptions, watch: Watch = lambda done, total: None) -> Cohort:
    """Read, inspect, split and, when asked to, align.

    Raises:
        InvalidParameter: none or several sources were named, or an option that does not go with the one.
        CohortError: the cohort cannot be used.
    """
    if sum(one is not None for one in (source.cohort, source.masks, source.meshes)) != 1:
        raise InvalidParameter(
            "One of --cohort, --masks and --meshes must be given; exactly one is accepted.", part="cohort"
        )
    if options.shippable_only and source.cohort is None:
        raise InvalidParameter("A folder of masks has no licence; --shippable goes with --cohort.", part="shippable")
    check_given(source, [one.name for one in fields(source) if getattr(source, one.name) != one.default])
    checked_labels(frozenset(source.labels) or None)
    found = _read(source, options)
    if source.side is not None:
        found = replace(found, side=SideName(source.side).value)
    if not source.align:
        return found
    from training.cohorts.alignment import align

    return align(found, watch)


def _read(source: CohortSource, options: CohortOptions) -> Cohort:
    if source.cohort is not None:
        return load_cohort(source.cohort, data_folder(source.data), options)
    if source.meshes is not None:
        from training.cohorts.meshes import read_meshes  # VTK is loaded for meshes alone

        return read_meshes(source.meshes, options, how=Voxelising(source.spacing_mm, source.space))
    return read_masks(source.masks or Path(), source.layout, options, source.labels, source.spacing_mm)


def read_masks(
    path: Path, layout: LayoutName, options: CohortOptions, labels: tuple[int, ...] = (), spacing_mm: float = 1.0
) -> Cohort:
    """Masks of a layout.

    Raises:
        CohortError: the cohort cannot be used.
    """
    match layout:
        case LayoutName.FOLDER:
            return read_folder(path, options, labels=labels)
        case LayoutName.DECATHLON:
            return read_decathlon(path, options, labels=labels)
        case LayoutName.MEDMNIST:
            return read_medmnist(path, options, spacing_mm=Voxelising(spacing_mm).spacing_mm)
        case LayoutName.VERSE:
            return read_verse(path, options, labels=labels)
        case LayoutName.OAI_ZIB:
            return read_oai_zib(path, options, labels=labels)
