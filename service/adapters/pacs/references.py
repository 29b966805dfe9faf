"""Which images a drawing refers to: while some are on their way, nothing is made of the others."""

from collections.abc import Iterable, Iterator

from pydicom import Dataset
from pydicom.uid import RTStructureSetStorage

from service.adapters.dicom.objects import tolerant


def referenced_images(found: Dataset, series: str) -> frozenset[str]:
    """SOP Instance UIDs of the images of a series that a drawing names; none where it names the series alone.

    A contour names its image without the series: what the drawing lists under another series is not of this one.

    Raises:
        UnreadableImage: damaged.
    """
    with tolerant("object"):
        if found.get("SOPClassUID") != RTStructureSetStorage:
            return _listed(_series_of_segmentation(found), "ReferencedInstanceSequence").get(series, _NONE)
        listed = _listed(_series_of(found), "ContourImageSequence")
        others = frozenset[str]().union(*(images for uid, images in listed.items() if uid != series))
        return listed.get(series, _NONE) | (frozenset(_images_of_contours(found)) - others)


_NONE: frozenset[str] = frozenset()


def _listed(items: Iterable[Dataset], name: str) -> dict[str, frozenset[str]]:
    """Images by series."""
    listed: dict[str, frozenset[str]] = {}
    for item in items:
        series = str(item.SeriesInstanceUID)
        listed[series] = listed.get(series, _NONE) | frozenset(_instances(item, name))
    return listed


def _series_of_segmentation(found: Dataset) -> Iterator[Dataset]:
    for study in (found, *(found.get("StudiesContainingOtherReferencedInstancesSequence") or [])):
        yield from study.get("ReferencedSeriesSequence") or []


def _series_of(found: Dataset) -> Iterator[Dataset]:
    for frame in found.get("ReferencedFrameOfReferenceSequence") or []:
        for study in frame.get("RTReferencedStudySequence") or []:
            yield from study.get("RTReferencedSeriesSequence") or []


def _images_of_contours(found: Dataset) -> Iterator[str]:
    for region in found.get("ROIContourSequence") or []:
        for contour in region.get("ContourSequence") or []:
            yield from _instances(contour, "ContourImageSequence")


def _instances(item: Dataset, name: str) -> Iterator[str]:
    for reference in item.get(name) or []:
        yield str(reference.ReferencedSOPInstanceUID)
