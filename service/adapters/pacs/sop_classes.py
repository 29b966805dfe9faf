"""What is spoken with archives: classes and transfer syntaxes. The conformance statement is made of these tables."""

from pydicom.uid import (
    UID,
    EncapsulatedSTLStorage,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    ParametricMapStorage,
    RLELossless,
    SegmentationStorage,
    SurfaceSegmentationStorage,
)
from pynetdicom import ALL_TRANSFER_SYNTAXES, AllStoragePresentationContexts

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
#: Images that drawings refer to; what a retrieval can bring.
IMAGES = tuple(UID(f"1.2.840.10008.5.1.4.1.1.{tail}") for tail in ("4", "4.1", "4.4", "2", "2.1", "128", "130", "7"))
#: Every other storage class: acknowledged and left alone, so that an archive may forward whatever comes.
LEFT_ALONE = tuple(
    UID(uid)
    for uid in sorted({*(str(context.abstract_syntax) for context in AllStoragePresentationContexts), *SENT})
    if uid not in RECEIVED
)
LEFT_ALONE_SYNTAXES = tuple(UID(uid) for uid in ALL_TRANSFER_SYNTAXES)
#: Accepted for drawings, and proposed for everything else.
ACCEPTED_SYNTAXES = (ExplicitVRLittleEndian, ImplicitVRLittleEndian, RLELossless)
PROPOSED_SYNTAXES = (ExplicitVRLittleEndian, ImplicitVRLittleEndian)
