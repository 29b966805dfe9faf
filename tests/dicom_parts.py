"""What tests of DICOM share: an image series, drawings on it as SEG and RTSTRUCT, the checkers of other houses."""

import io
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import highdicom as hd
import numpy as np
from jaxtyping import Float
from pydicom import Dataset, dcmread
from pydicom.dataset import FileMetaDataset
from pydicom.sequence import Sequence as Items
from pydicom.sr.codedict import codes
from pydicom.uid import ExplicitVRLittleEndian, MRImageStorage, RTStructureSetStorage, generate_uid

from model.geometry import Grid
from service.adapters.image_guard import LPS_TO_RAS

#: Names that must not stand in any log, metric or file name.
PATIENT_NAME, PATIENT_ID = "Zweig^Ada", "SECRET-4711"
AXIAL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def mr_series(
    size: tuple[int, int, int] = (36, 30, 26),
    *,
    spacing: tuple[float, float, float] = (1.0, 1.0, 1.0),
    origin: tuple[float, float, float] = (40.0, -15.0, 8.0),
    directions: tuple[tuple[float, ...], tuple[float, ...]] = AXIAL,
    study: str | None = None,
    patient: str = PATIENT_ID,
) -> list[Dataset]:
    """Single-frame MR images: columns, rows and planes; spacing between columns, rows and planes (mm); LPS."""
    normal = np.cross(*directions)
    shared = {"StudyInstanceUID": study or generate_uid(), "SeriesInstanceUID": generate_uid()}
    shared["FrameOfReferenceUID"] = generate_uid()
    images = []
    for number in range(size[2]):
        position = np.array(origin) + number * spacing[2] * normal
        images.append(_image(size, spacing, position, directions, number, {**shared, "PatientID": patient}))
    return images


def _image(size, spacing, position, directions, number, shared) -> Dataset:
    image = Dataset()
    image.file_meta = FileMetaDataset()
    image.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    image.SOPClassUID = image.file_meta.MediaStorageSOPClassUID = MRImageStorage
    image.SOPInstanceUID = image.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    image.PatientName, image.PatientBirthDate, image.PatientSex = PATIENT_NAME, "19610503", "F"
    image.StudyDate, image.StudyTime, image.StudyID, image.AccessionNumber = "20240102", "030405", "9", "ACC-77"
    image.ReferringPhysicianName, image.Modality, image.Manufacturer = "Doc^Tor", "MR", "Maker"
    image.SeriesNumber, image.InstanceNumber, image.ImageType = 3, number + 1, ["ORIGINAL", "PRIMARY", "M", "NONE"]
    image.PatientPosition, image.BodyPartExamined, image.Laterality = "HFS", "BRAIN", ""
    image.ScanningSequence, image.SequenceVariant, image.ScanOptions, image.MRAcquisitionType = "GR", "SP", "", "3D"
    image.RepetitionTime, image.EchoTime, image.EchoTrainLength, image.InversionTime = 20, 5, 1, None
    image.ImagePositionPatient = [round(float(x), 6) for x in position]
    image.ImageOrientationPatient = [round(float(x), 9) for direction in directions for x in direction]
    image.PixelSpacing, image.SliceThickness = [spacing[1], spacing[0]], spacing[2]
    image.Rows, image.Columns, image.SamplesPerPixel, image.PhotometricInterpretation = (
        size[1],
        size[0],
        1,
        "MONOCHROME2",
    )
    image.BitsAllocated, image.BitsStored, image.HighBit, image.PixelRepresentation = 16, 16, 15, 0
    image.PixelData = np.full((size[1], size[0]), number, np.uint16).tobytes()
    for name, value in shared.items():
        setattr(image, name, value)
    return image


def grid_of(images: Sequence[Dataset]) -> Grid:
    """The voxel grid of images in order, worked out anew from the standard's equation (PS3.3, C.7.6.2.1.1)."""
    first, second = images[0], images[1]
    row, column = np.array(first.ImageOrientationPatient, float).reshape(2, 3)
    between_rows, between_columns = map(float, first.PixelSpacing)
    affine = np.eye(4)
    affine[:3, 0], affine[:3, 1] = row * between_columns, column * between_rows
    affine[:3, 2] = np.array(second.ImagePositionPatient, float) - np.array(first.ImagePositionPatient, float)
    affine[:3, 3] = first.ImagePositionPatient
    return Grid((int(first.Columns), int(first.Rows), len(images)), LPS_TO_RAS @ affine)


def segment(number: int = 1, label: str = "hippocampus") -> hd.seg.SegmentDescription:
    """A hand-drawn segment."""
    return hd.seg.SegmentDescription(
        number, label, codes.SCT.AnatomicalStructure, codes.SCT.Hippocampus, hd.seg.SegmentAlgorithmTypeValues.MANUAL
    )


def seg_of(
    images: Sequence[Dataset],
    volume: np.ndarray,
    kind: str = "BINARY",
    labels: Sequence[str] = ("hippocampus",),
    **more,
) -> hd.seg.Segmentation:
    """A drawing (column, row, plane[, segment]) on all images, empty planes left out unless told otherwise."""
    frames = np.moveaxis(volume, (0, 1, 2), (2, 1, 0))
    return hd.seg.Segmentation(
        images,
        frames,
        kind,
        [segment(number, label) for number, label in enumerate(labels, 1)],
        generate_uid(),
        7,
        generate_uid(),
        1,
        "Maker",
        "Model",
        "1",
        "1",
        **more,
    )


def rtstruct_of(images: Sequence[Dataset], contours: Sequence[tuple[str, Float[np.ndarray, "n 3"]]]) -> Dataset:
    """A structure set of one region: geometric types and points (LPS mm)."""
    found = Dataset()
    found.file_meta = FileMetaDataset()
    found.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    found.SOPClassUID = found.file_meta.MediaStorageSOPClassUID = RTStructureSetStorage
    found.SOPInstanceUID = found.file_meta.MediaStorageSOPInstanceUID = generate_uid()
    for name in ("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyInstanceUID", "StudyDate"):
        setattr(found, name, images[0][name].value)
    found.Modality, found.SeriesInstanceUID = "RTSTRUCT", generate_uid()
    series, study, reference = Dataset(), Dataset(), Dataset()
    series.SeriesInstanceUID = images[0].SeriesInstanceUID
    series.ContourImageSequence = Items([_reference(image) for image in images])
    study.RTReferencedSeriesSequence = Items([series])
    reference.FrameOfReferenceUID = images[0].FrameOfReferenceUID
    reference.RTReferencedStudySequence = Items([study])
    found.ReferencedFrameOfReferenceSequence = Items([reference])
    region, drawn = Dataset(), Dataset()
    region.ROINumber, region.ROIName = 1, "hippocampus"
    region.ReferencedFrameOfReferenceUID = images[0].FrameOfReferenceUID
    found.StructureSetROISequence = Items([region])
    drawn.ReferencedROINumber, drawn.ContourSequence = 1, Items([_contour(*contour) for contour in contours])
    found.ROIContourSequence = Items([drawn])
    return found


def with_region(found: Dataset, other: Dataset, number: int = 2) -> Dataset:
    """A structure set with the region of another one, under a number of its own, and what that refers to."""
    both, added = reread(found), reread(other)
    added.StructureSetROISequence[0].ROINumber = added.ROIContourSequence[0].ReferencedROINumber = number
    for name in ("ReferencedFrameOfReferenceSequence", "StructureSetROISequence", "ROIContourSequence"):
        both[name].value.append(added[name].value[0])
    return both


def name_images(found: Dataset, images: Sequence[Dataset]) -> None:
    """Let each contour of the first region name its image."""
    for contour, image in zip(found.ROIContourSequence[0].ContourSequence, images, strict=True):
        contour.ContourImageSequence = Items([_reference(image)])


def _reference(image: Dataset) -> Dataset:
    item = Dataset()
    item.ReferencedSOPClassUID, item.ReferencedSOPInstanceUID = image.SOPClassUID, image.SOPInstanceUID
    return item


def _contour(kind: str, points: Float[np.ndarray, "n 3"]) -> Dataset:
    item = Dataset()
    item.ContourGeometricType, item.NumberOfContourPoints = kind, len(points)
    item.ContourData = [f"{value:.6g}" for value in np.ravel(points)]
    return item


def ring(images, number: int, radii: tuple[float, ...]):
    """Squares around the middle of an image, in LPS mm."""
    image = images[number]
    row, column = np.array(image.ImageOrientationPatient, float).reshape(2, 3)
    middle = (
        np.array(image.ImagePositionPatient, float)
        + (int(image.Columns) / 2 - 2.7) * row
        + (int(image.Rows) / 2 - 2.6) * column
    )
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    return [middle + radius * (corners @ np.stack([row, column])) for radius in radii]


def two_boxes(size: tuple[int, int, int]) -> np.ndarray:
    """Two structures beside each other (column, row, plane, segment)."""
    both = np.zeros((*size, 2), np.uint8)
    both[3:6, 3:6, 3:6, 0] = both[7:9, 3:6, 3:6, 1] = 1
    return both


def file_bytes(found: Dataset) -> bytes:
    """The object as a DICOM file with its preamble."""
    buffer = io.BytesIO()
    found.save_as(buffer, enforce_file_format=True)
    return buffer.getvalue()


def reread(found: Dataset) -> Dataset:
    """The object as another program gets it."""
    return dcmread(io.BytesIO(file_bytes(found)))


def checker_errors(data: bytes, folder: Path) -> list[str]:
    """What dciodvfy holds against an object; the checker has to be there."""
    path = folder / "checked.dcm"
    path.write_bytes(data)
    run = subprocess.run([shutil.which("dciodvfy") or "dciodvfy", path], capture_output=True, text=True, check=False)
    return [line for line in (run.stdout + run.stderr).splitlines() if line.startswith("Error")]
