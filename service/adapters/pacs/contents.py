"""What a drawing draws, in a digest: an object that was corrected under its old identifier is another drawing."""

import hashlib
from collections.abc import Iterator, Sequence

import numpy as np
from pydicom import Dataset

from model.inference.mask_stack import MaskStack
from service.adapters.dicom.objects import tolerant

#: Sequences that describe segments or regions, and the number that each item is of.
DESCRIPTIONS = {
    "SegmentSequence": "SegmentNumber",
    "StructureSetROISequence": "ROINumber",
    "RTROIObservationsSequence": "ReferencedROINumber",
}
#: Steps of a millimetre in which grids are compared: a power of two, so that no decimal of a header is halfway.
STEPS_PER_MM = 1 << 16


def content_digest(found: Dataset, stacks: Sequence[MaskStack], labels: frozenset[int] | None = None) -> str:
    """SHA-256 of the chosen segments or regions: what is said of them, and the voxels that they cover.

    The encoding of the pixels, and what archives may update on the way (patient, study, dates), do not count.

    Args:
        found: the drawing.
        stacks: as they were read from it.
        labels: numbers of the segments or regions; all when None.

    Raises:
        UnreadableImage: damaged.
    """
    digest = hashlib.sha256()
    with tolerant("object"):
        for item in _descriptions(found, labels):
            digest.update(item.to_json(bulk_data_threshold=1 << 62, suppress_invalid_tags=True).encode())
    for stack in stacks:
        steps = np.rint(stack.grid.affine * STEPS_PER_MM).astype(np.int64)
        digest.update(f"{stack.grid.shape}\n{steps.tolist()}\n".encode())
        digest.update(np.packbits(stack.foreground).tobytes() + np.packbits(stack.excluded).tobytes())
    return digest.hexdigest()


def _descriptions(found: Dataset, labels: frozenset[int] | None) -> Iterator[Dataset]:
    for name, number in DESCRIPTIONS.items():
        for item in found.get(name) or []:
            if labels is None or int(item[number].value) in labels:
                yield item
