"""What every result of a drawing shares: where it comes from, what it is of, and who made it.

Identifiers are pure functions of their key, so that work done twice gives the same objects and an archive
keeps each of them once (UUID-derived UIDs, PS3.5, B.2).
"""

import uuid
from dataclasses import dataclass
from typing import Any

import highdicom as hd
import numpy as np
from jaxtyping import Float
from pydicom import Dataset
from pydicom.sequence import Sequence as Items
from pydicom.sr.codedict import codes
from pydicom.sr.coding import Code
from pydicom.uid import UID

from model.bundle import Manifest
from service.adapters.dicom.laterality import SIDES
from service.adapters.dicom.masks import label_names
from service.adapters.dicom.series import Series
from service.ports import Outcome

MANUFACTURER = "MorphoFlow"
#: Stands in every description: what these objects are not for.
PURPOSE = "not for primary diagnosis"
#: Stands in the report: what the results are, and what they are not for.
DISCLAIMER = f"derived, {PURPOSE}"
#: First number of the series that results are put in, by what they hold.
SERIES_NUMBERS = {"segmentation": 9001, "maps": 9002, "report": 9003, "model": 9004}
#: How far the surface may leave the outermost voxels' centres before the segmentation counts as cut (voxels).
CUT_MARGIN = 0.5
#: Characters of a segment's label (VR LO).
LONGEST_LABEL = 64
#: Largest number of a segment or region that a description has room for.
LARGEST_DESCRIBED = 999


@dataclass(frozen=True)
class Derivation:
    """One drawing and what was made of it.

    Attributes:
        drawing: the object that was sent, without pixels.
        series: the images that it was drawn on.
        outcome: the reconstruction.
        anatomy: what it is of.
        key: the same for the same drawing, model and settings; decides all identifiers.
        version: of this program.
        labels: numbers of the drawing's segments or regions that it was made of; all of them when None.
        side: letter of the side it is on (`service.adapters.dicom.laterality`), empty when it is not known.
    """

    drawing: Dataset
    series: Series
    outcome: Outcome
    anatomy: Code
    key: str
    version: str
    labels: frozenset[int] | None = None
    side: str = ""

    def uid(self, name: str) -> UID:
        """Identifier of one object or series of the results."""
        return UID(f"2.25.{uuid.uuid5(uuid.NAMESPACE_OID, f'{self.key}/{name}').int}")

    @property
    def model(self) -> str:
        """Name and version of the model, for people."""
        return f"{self.outcome.model_name} {self.outcome.model_version}"

    @property
    def structure(self) -> tuple[int, str] | None:
        """Number and name of the segment or region that it was made of; None for all that the drawing has."""
        names = label_names(self.drawing, "drawing")
        if self.labels is None or len(self.labels) > 1 or len(names) < 2:
            return None
        (number,) = self.labels
        return number, names.get(number, "")

    @property
    def label(self) -> str:
        """What the structure is called: as drawn where the drawing has several, else as the model is, and its side."""
        _, name = self.structure or (0, "")
        side = f", {SIDES[self.side].meaning.lower()}" if self.side else ""
        return name[:LONGEST_LABEL] or f"{self.outcome.model_name[: LONGEST_LABEL - len(side)]}{side}"

    @property
    def is_cut(self) -> bool:
        """Whether the surface reaches beyond the images, so that a segmentation on their frames lacks a part."""
        grid = self.series.grid
        index = grid.to_index(self.outcome.reconstruction.mesh.vertices)
        return bool((index < -CUT_MARGIN).any() or (index > np.array(grid.shape) - 1 + CUT_MARGIN).any())

    def description(self, what: str) -> str:
        """What an object holds, whether that is cut, and what it is not for; 64 characters at most (VR LO)."""
        number, _ = self.structure or (0, "")
        what += f" #{number}" if 0 < number <= LARGEST_DESCRIBED else ""
        return f"{what}, CUT at border ({PURPOSE})" if self.is_cut else f"{what} ({DISCLAIMER})"

    def equipment(self) -> dict[str, Any]:
        """The maker of the objects as highdicom's arguments."""
        return {
            "manufacturer": MANUFACTURER,
            "manufacturer_model_name": self.model,
            "software_versions": self.version,
            "device_serial_number": self.outcome.model_digest[:16],
        }

    def place(self, series: str, name: str, number: int = 1) -> dict[str, Any]:
        """The series and instance that a result goes to, as highdicom's arguments."""
        return {
            "series_instance_uid": self.uid(f"series/{series}"),
            "series_number": SERIES_NUMBERS[series],
            "sop_instance_uid": self.uid(name),
            "instance_number": number,
        }

    def parameters(self) -> dict[str, str]:
        """What the result depends on beside drawing and model."""
        options = self.outcome.options
        return {
            "bundle_sha256": self.outcome.model_digest,
            "uncertainty": options.uncertainty,
            "mirror": options.mirror,
            "seed": str(options.seed),
        }


def algorithm(derivation: Derivation) -> hd.AlgorithmIdentificationSequence:
    """Name, version and bundle hash of the algorithm."""
    return hd.AlgorithmIdentificationSequence(
        name=f"{MANUFACTURER} {derivation.outcome.model_name}",
        family=codes.DCM.ArtificialIntelligence,
        version=f"{derivation.version}, model {derivation.outcome.model_version}",
        source=MANUFACTURER,
        parameters=derivation.parameters(),
    )


def anatomy_of(manifest: Manifest) -> Code:
    """The structure's code as the manifest says it; an anatomical structure at large when it says none."""
    if not manifest.anatomy:
        return Code("91723000", "SCT", "Anatomical structure")
    return Code(manifest.anatomy["value"], manifest.anatomy["scheme"], manifest.anatomy["meaning"])


def property_type(derivation: Derivation) -> hd.sr.CodedConcept:
    """The structure's code, with its side as modifier where that is known (PS3.3, C.8.20.2)."""
    anatomy = hd.sr.CodedConcept.from_code(derivation.anatomy)
    if derivation.side:
        side = hd.sr.CodedConcept.from_code(SIDES[derivation.side])
        anatomy.SegmentedPropertyTypeModifierCodeSequence = Items([side])
    return anatomy


def frames_on(series: Series, volume: Float[np.ndarray, "i j k"]) -> Float[np.ndarray, "k j i"]:
    """A volume on the grid of the series as frames of rows and columns, in the order of its images."""
    return np.ascontiguousarray(np.moveaxis(volume, (0, 1, 2), (2, 1, 0))[list(series.order)])


def references(derivation: Derivation) -> list[Dataset]:
    """The drawing and the images, as items of a sequence of instances of one study."""
    items = []
    for source in (derivation.drawing, *derivation.series.images):
        item = Dataset()
        item.ReferencedSOPClassUID, item.ReferencedSOPInstanceUID = source.SOPClassUID, source.SOPInstanceUID
        items.append(item)
    return items
