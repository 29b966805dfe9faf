"""All objects that one reconstruction is given back as."""

import numpy as np
from jaxtyping import Float
from pydicom import Dataset

from model.inference.uncertainty import voxel_entropy
from service.adapters.dicom.derivation import Derivation
from service.adapters.dicom.objects import quiet
from service.adapters.dicom.result_images import entropy_map, occupancy_map, segmentation
from service.adapters.dicom.result_report import report
from service.adapters.dicom.result_surfaces import encapsulated_stl, surface_segmentation
from service.use_cases import OCCUPIED

#: Names of the results, in the order in which they are sent: what is referred to comes first.
RESULTS = ("segmentation", "occupancy", "entropy", "stl", "surface", "report")


def result_objects(derivation: Derivation, probability: Float[np.ndarray, "i j k"]) -> dict[str, Dataset]:
    """The results by name, in the order of `RESULTS`.

    Args:
        probability: occupancy on the grid of the series.
    """
    with quiet():
        drawn = segmentation(derivation, probability >= OCCUPIED)
        return {
            "segmentation": drawn,
            "occupancy": occupancy_map(derivation, probability),
            "entropy": entropy_map(derivation, voxel_entropy(probability.astype(float))),
            "stl": encapsulated_stl(derivation),
            "surface": surface_segmentation(derivation),
            "report": report(derivation, drawn),
        }
