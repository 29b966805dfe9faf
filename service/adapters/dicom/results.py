"""All objects that one reconstruction is given back as."""

from collections.abc import Iterable
from datetime import datetime, tzinfo

import numpy as np
from jaxtyping import Float
from pydicom import Dataset
from pydicom.valuerep import DA, TM

from model.inference.one_body import OCCUPIED
from model.inference.uncertainty import voxel_entropy
from service.adapters.dicom.derivation import Derivation
from service.adapters.dicom.result_images import entropy_map, occupancy_map, segmentation
from service.adapters.dicom.result_report import report
from service.adapters.dicom.result_surfaces import encapsulated_stl, surface_segmentation
from service.adapters.quiet import quiet

#: Names of the results, in the order in which they are sent: what is referred to comes first.
RESULTS = ("segmentation", "occupancy", "entropy", "stl", "surface", "report")


def result_objects(
    derivation: Derivation, probability: Float[np.ndarray, "i j k"], moment_s: float
) -> dict[str, Dataset]:
    """The results by name, in the order of `RESULTS`.

    Args:
        probability: occupancy on the grid of the series.
        moment_s: when they are made, which all of them say (seconds since 1970).
    """
    with quiet():
        drawn = segmentation(derivation, probability >= OCCUPIED)
        results = {
            "segmentation": drawn,
            "occupancy": occupancy_map(derivation, probability),
            "entropy": entropy_map(derivation, voxel_entropy(probability.astype(float))),
            "stl": encapsulated_stl(derivation),
            "surface": surface_segmentation(derivation),
            "report": report(derivation, drawn),
        }
        _date(results.values(), moment_s, time_zone(derivation.series.images[0]))
        return results


def time_zone(image: Dataset) -> tzinfo | None:
    """The one that all dates and times of an image are in; None where it does not say."""
    try:
        return datetime.strptime(str(image.get("TimezoneOffsetFromUTC") or ""), "%z").tzinfo
    except ValueError:
        return None


def _date(results: Iterable[Dataset], moment_s: float, zone: tzinfo | None) -> None:
    """One moment for all, in the images' time zone; in the machine's where they name none.

    An offset is said to be that of all dates of an object, so also of the study's, which come from the images.
    """
    moment = datetime.fromtimestamp(moment_s, zone)
    for found in results:
        found.InstanceCreationDate, found.InstanceCreationTime = DA(moment.date()), TM(moment.time())
        found.ContentDate, found.ContentTime = found.InstanceCreationDate, found.InstanceCreationTime
        if zone is not None:
            found.TimezoneOffsetFromUTC = moment.strftime("%z")
