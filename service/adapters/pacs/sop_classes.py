"""What is spoken with archives: classes and transfer syntaxes. The conformance statement is made of these tables."""

from collections.abc import Sequence

from pydicom.uid import (
    UID,
    BreastTomosynthesisImageStorage,
    CTImageStorage,
    EncapsulatedSTLStorage,
    EnhancedCTImageStorage,
    EnhancedMRColorImageStorage,
    EnhancedMRImageStorage,
    EnhancedPETImageStorage,
    EnhancedUSVolumeStorage,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000TransferSyntaxes,
    JPEGLSTransferSyntaxes,
    JPEGTransferSyntaxes,
    LegacyConvertedEnhancedCTImageStorage,
    LegacyConvertedEnhancedMRImageStorage,
    LegacyConvertedEnhancedPETImageStorage,
    MRImageStorage,
    MultiFrameGrayscaleByteSecondaryCaptureImageStorage,
    MultiFrameGrayscaleWordSecondaryCaptureImageStorage,
    NuclearMedicineImageStorage,
    OphthalmicTomographyImageStorage,
    ParametricMapStorage,
    PositronEmissionTomographyImageStorage,
    RLELossless,
    RLETransferSyntaxes,
    SecondaryCaptureImageStorage,
    SegmentationStorage,
    SurfaceSegmentationStorage,
    XRay3DAngiographicImageStorage,
    XRay3DCraniofacialImageStorage,
)
from pynetdicom import ALL_TRANSFER_SYNTAXES, AllStoragePresentationContexts, build_context
from pynetdicom.presentation import PresentationContext

from service.adapters.dicom.masks import DRAWINGS

VERIFICATION = UID("1.2.840.10008.1.1")
FIND, MOVE, GET = (UID(f"1.2.840.10008.5.1.4.1.2.2.{number}") for number in (1, 2, 3))
COMMITMENT, COMMITMENT_INSTANCE = UID("1.2.840.10008.1.20.1"), UID("1.2.840.10008.1.20.1.1")
#: Drawings that are accepted.
RECEIVED = DRAWINGS
#: Results that are sent.
SENT = (
    SegmentationStorage,
    ParametricMapStorage,
    UID("1.2.840.10008.5.1.4.1.1.88.34"),
    EncapsulatedSTLStorage,
    SurfaceSegmentationStorage,
)
#: Images that have a place in the patient, on which drawings are made; what a retrieval brings.
IMAGES = (
    MRImageStorage,
    EnhancedMRImageStorage,
    EnhancedMRColorImageStorage,
    LegacyConvertedEnhancedMRImageStorage,
    CTImageStorage,
    EnhancedCTImageStorage,
    LegacyConvertedEnhancedCTImageStorage,
    PositronEmissionTomographyImageStorage,
    EnhancedPETImageStorage,
    LegacyConvertedEnhancedPETImageStorage,
    NuclearMedicineImageStorage,
    EnhancedUSVolumeStorage,
    XRay3DAngiographicImageStorage,
    XRay3DCraniofacialImageStorage,
    BreastTomosynthesisImageStorage,
    OphthalmicTomographyImageStorage,
    SecondaryCaptureImageStorage,
    MultiFrameGrayscaleByteSecondaryCaptureImageStorage,
    MultiFrameGrayscaleWordSecondaryCaptureImageStorage,
)
#: Every storage class.
STORAGE = frozenset(str(context.abstract_syntax) for context in AllStoragePresentationContexts)
#: Every other storage class: acknowledged and left alone, so that an archive may forward whatever comes.
LEFT_ALONE = tuple(UID(uid) for uid in sorted(STORAGE.union(SENT)) if uid not in RECEIVED)
LEFT_ALONE_SYNTAXES = tuple(UID(uid) for uid in ALL_TRANSFER_SYNTAXES)
#: Accepted for drawings, and proposed for everything else.
ACCEPTED_SYNTAXES = (ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless)
PROPOSED_SYNTAXES = (ExplicitVRLittleEndian, ImplicitVRLittleEndian)
#: For images that are fetched; their pixels are never decoded.
IMAGE_SYNTAXES = (
    *PROPOSED_SYNTAXES,
    *JPEG2000TransferSyntaxes,
    *JPEGTransferSyntaxes,
    *JPEGLSTransferSyntaxes,
    *RLETransferSyntaxes,
)
#: Contexts of one association (PS3.8, 9.3.2.2), less those of queries and retrievals.
MOST_CONTEXTS = 128 - 2


def image_contexts(classes: Sequence[str]) -> list[PresentationContext]:
    """What a retrieval by C-GET proposes: each syntax by itself, as an archive sends in the one that it accepts.

    Where there are too many classes for that, each comes once, and the archive chooses among the syntaxes.
    """
    alone = len(classes) * len(IMAGE_SYNTAXES) <= MOST_CONTEXTS
    choices: list[list[str | UID]] = [[syntax] for syntax in IMAGE_SYNTAXES] if alone else [list(IMAGE_SYNTAXES)]
    return [build_context(uid, choice) for uid in classes[:MOST_CONTEXTS] for choice in choices]
