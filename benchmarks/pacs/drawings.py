"""Image series and drawings on them, as a viewer would send them."""

from collections.abc import Sequence
from pathlib import Path

import highdicom as hd
import nibabel as nib
import numpy as np
from jaxtyping import Bool, Float
from pydicom import Dataset, dcmread
from pydicom.dataset import FileMetaDataset
from pydicom.sr.codedict import codes
from pydicom.uid import ExplicitVRLittleEndian, MRImageStorage, generate_uid

from model.geometry import Grid
from service.adapters.dicom.series import series_of
from service.adapters.image_guard import LPS_TO_RAS

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "hippocampus_three_slices.nii.gz"
#: Planes drawn of the object's extent.
PLANES = 3


def real_series(folder: Path) -> list[Dataset]:
    """The images of a folder in the order of their planes."""
    return list(series_of([dcmread(path) for path in folder.glob("*.dcm")]).images)


def series_around(grid: Grid, patient: str = "SCENE-1") -> list[Dataset]:
    """An MR series without content on a grid whose planes are along its last axis."""
    lps = LPS_TO_RAS @ grid.affine
    common = Dataset()
    common.SOPClassUID, common.Modality, common.Manufacturer = MRImageStorage, "MR", "Scene"
    common.PatientName, common.PatientID, common.PatientBirthDate, common.PatientSex = "Scene^One", patient, "", ""
    common.StudyInstanceUID, common.SeriesInstanceUID, common.FrameOfReferenceUID = (generate_uid() for _ in range(3))
    common.StudyDate, common.StudyTime, common.StudyID, common.AccessionNumber = "20240102", "030405", "1", ""
    common.ReferringPhysicianName, common.SeriesNumber, common.BodyPartExamined = "", 1, "BRAIN"
    common.Columns, common.Rows = grid.shape[0], grid.shape[1]
    common.SamplesPerPixel, common.PhotometricInterpretation, common.PixelRepresentation = 1, "MONOCHROME2", 0
    common.BitsAllocated, common.BitsStored, common.HighBit = 16, 16, 15
    common.PixelSpacing = [float(grid.spacing[1]), float(grid.spacing[0])]
    common.SliceThickness = float(grid.spacing[2])
    axes = lps[:3, :2] / grid.spacing[:2]
    common.ImageOrientationPatient = [round(float(x), 9) for x in axes.T.ravel()]
    return [_image(common, lps, number) for number in range(grid.shape[2])]


def _image(common: Dataset, lps: Float[np.ndarray, "4 4"], number: int) -> Dataset:
    image = Dataset()
    image.update(common)
    image.SOPInstanceUID, image.InstanceNumber = generate_uid(), number + 1
    image.ImagePositionPatient = [round(float(x), 6) for x in lps[:3, 3] + number * lps[:3, 2]]
    image.PixelData = np.full((image.Rows, image.Columns), 100 + number, np.uint16).tobytes()
    image.file_meta = FileMetaDataset()
    image.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    image.file_meta.MediaStorageSOPClassUID = image.SOPClassUID
    image.file_meta.MediaStorageSOPInstanceUID = image.SOPInstanceUID
    return image


def placed(mask: Path, grid: Grid) -> Bool[np.ndarray, "i j k"]:
    """A mask of anatomy (NIfTI) in the middle of a grid, by nearest voxels; orientations in the world are kept."""
    loaded = nib.Nifti1Image.from_filename(mask)
    values = np.asarray(loaded.dataobj) > 0
    own = Grid(values.shape, np.asarray(loaded.affine, float))
    middle = own.to_world(np.argwhere(values).astype(float)).mean(axis=0)
    centre = grid.to_world((np.array([grid.shape], float) - 1) / 2)[0]
    index = np.rint(own.to_index(grid.centres() - centre + middle)).astype(int)
    inside = ((index >= 0) & (index < values.shape)).all(axis=1)
    found = np.zeros(len(index), bool)
    found[inside] = values[tuple(index[inside].T)]
    return found.reshape(grid.shape)


def three_planes(object_: Bool[np.ndarray, "i j k"]) -> Bool[np.ndarray, "i j k"]:
    """The object on three planes along the last axis: at a sixth, a half and five sixths of its extent."""
    held = np.flatnonzero(object_.any(axis=(0, 1)))
    chosen = held[[round((2 * n + 1) * (len(held) - 1) / (2 * PLANES)) for n in range(PLANES)]]
    drawn = np.zeros_like(object_)
    drawn[:, :, chosen] = object_[:, :, chosen]
    return drawn


def as_seg(images: Sequence[Dataset], drawn: Bool[np.ndarray, "i j k"], label: str = "hippocampus") -> Dataset:
    """The drawing as a segmentation object; planes without drawing have no frame."""
    segment = hd.seg.SegmentDescription(
        1, label, codes.SCT.AnatomicalStructure, codes.SCT.Hippocampus, hd.seg.SegmentAlgorithmTypeValues.MANUAL
    )
    return hd.seg.Segmentation(
        images,
        np.moveaxis(drawn, (0, 1, 2), (2, 1, 0)).astype(np.uint8),
        hd.seg.SegmentationTypeValues.BINARY,
        [segment],
        generate_uid(),
        900,
        generate_uid(),
        1,
        "Scene",
        "Viewer",
        "1",
        "1",
    )
