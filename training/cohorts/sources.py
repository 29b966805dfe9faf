"""Where a cohort comes from: a public one by name, masks in one of several layouts, or meshes."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from model.errors import InvalidParameter
from training.cohorts.assemble import CohortOptions
from training.cohorts.catalogue import CohortName, data_folder, load_cohort
from training.cohorts.cohort import Cohort
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

    @property
    def is_given(self) -> bool:
        """Whether any was asked for."""
        return any(one is not None for one in (self.cohort, self.masks, self.meshes))


def open_cohort(source: CohortSource, options: CohortOptions) -> Cohort:
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
    if source.layout is not LayoutName.FOLDER and source.masks is None:
        raise InvalidParameter("A layout is one of masks; --layout goes with --masks.", part="layout")
    found = _read(source, options)
    if not source.align:
        return found
    from training.cohorts.alignment import align

    return align(found)


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
            return read_medmnist(path, options, spacing_mm=spacing_mm)
        case LayoutName.VERSE:
            return read_verse(path, options, labels=labels)
        case LayoutName.OAI_ZIB:
            return read_oai_zib(path, options, labels=labels)
