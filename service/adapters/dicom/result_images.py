"""Results on the images' own frames: a segmentation and two parametric maps (PS3.3, A.51 and A.75)."""

import highdicom as hd
import numpy as np
from jaxtyping import Bool, Float
from pydicom import Dataset
from pydicom.sequence import Sequence
from pydicom.sr.codedict import codes
from pydicom.sr.coding import Code

from service.adapters.dicom.derivation import MANUFACTURER, Derivation, algorithm, frames_on, property_type
from service.adapters.dicom.laterality import UNPAIRED

#: Unit and upper bound of the entropy of a voxel that is inside or outside.
NAT = Code("{nat}", "UCUM", "nat")
ENTROPY_LIMIT = float(np.log(2.0))


def segmentation(derivation: Derivation, inside: Bool[np.ndarray, "i j k"]) -> hd.seg.Segmentation:
    """The reconstructed object on the images' frames; frames without it are left out.

    What lies beyond the images is not represented; the description says so.
    """
    segment = hd.seg.SegmentDescription(
        segment_number=1,
        segment_label=derivation.label,
        segmented_property_category=codes.SCT.AnatomicalStructure,
        segmented_property_type=property_type(derivation),
        algorithm_type=hd.seg.SegmentAlgorithmTypeValues.SEMIAUTOMATIC,
        algorithm_identification=algorithm(derivation),
        tracking_uid=derivation.uid("tracking"),
        tracking_id=derivation.label,
    )
    return hd.seg.Segmentation(
        derivation.series.images,
        frames_on(derivation.series, inside).astype(np.uint8),
        hd.seg.SegmentationTypeValues.BINARY,
        [segment],
        content_creator_name=MANUFACTURER,
        content_label="RECONSTRUCTION",
        content_description=derivation.description("Reconstruction"),
        series_description=derivation.description("Segmentation"),
        **derivation.equipment(),
        **derivation.place("segmentation", "segmentation"),
    )


def occupancy_map(derivation: Derivation, probability: Float[np.ndarray, "i j k"]) -> hd.pm.ParametricMap:
    """Probability of each voxel to belong to the object, 0 to 1."""
    quantity = Code("probability", "99MORPHOFLOW", "Occupancy probability")
    unit = codes.UCUM.NoUnits
    return _map(derivation, "occupancy", probability, quantity, unit, 1.0, 1)


def entropy_map(derivation: Derivation, entropy: Float[np.ndarray, "i j k"]) -> hd.pm.ParametricMap:
    """Entropy of each voxel (nats), 0 to ln 2."""
    quantity = Code("entropy", "99MORPHOFLOW", "Voxel entropy")
    return _map(derivation, "entropy", entropy, quantity, NAT, ENTROPY_LIMIT, 2)


def _map(
    derivation: Derivation,
    name: str,
    values: Float[np.ndarray, "i j k"],
    quantity: Code,
    unit: Code,
    top: float,
    number: int,
) -> hd.pm.ParametricMap:
    mapping = hd.pm.RealWorldValueMapping(
        lut_label=name.upper(),
        lut_explanation=quantity.meaning,
        unit=unit,
        value_range=(0.0, top),
        slope=1.0,
        intercept=0.0,
        quantity_definition=quantity,
    )
    found = hd.pm.ParametricMap(
        derivation.series.images,
        frames_on(derivation.series, values).astype(np.float32),
        contains_recognizable_visual_features=False,
        real_world_value_mappings=[mapping],
        voi_lut_transformations=[
            hd.VOILUTTransformation(window_center=top / 2, window_width=top, voi_lut_function="LINEAR_EXACT")
        ],
        content_creator_name=MANUFACTURER,
        content_label=name.upper(),
        content_description=derivation.description(name.capitalize()),
        series_description=derivation.description("Uncertainty maps"),
        **derivation.equipment(),
        **derivation.place("maps", name, number),
    )
    found.SharedFunctionalGroupsSequence[0].FrameAnatomySequence = Sequence([_frame_anatomy(derivation)])
    return found


def _frame_anatomy(derivation: Derivation) -> Dataset:
    """Anatomy of all frames (C.7.6.16.2.8), which readers want and has to name a side: unpaired where none is known."""
    anatomy = Dataset()
    anatomy.AnatomicRegionSequence = Sequence([hd.sr.CodedConcept.from_code(derivation.anatomy)])
    anatomy.FrameLaterality = derivation.side or UNPAIRED
    return anatomy
