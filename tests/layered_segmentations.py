"""Segmentations of 3-D Slicer whose segments overlap, so that they have several layers."""

import gzip
from collections.abc import Sequence

import numpy as np


def layered_segmentation(layers: Sequence[np.ndarray], segments: Sequence[tuple[int, int]] = ()) -> bytes:
    """A .seg.nrrd of layers of (6, 7, 8) voxels.

    Args:
        layers: label maps.
        segments: layer and label value of each segment that the header describes.
    """
    described = "".join(
        f"Segment{n}_ID:=Segment_{n}\nSegment{n}_LabelValue:={value}\nSegment{n}_Layer:={layer}\n"
        for n, (layer, value) in enumerate(segments)
    )
    header = (
        "NRRD0004\ntype: uchar\ndimension: 4\nspace: left-posterior-superior\n"
        f"sizes: {len(layers)} 6 7 8\nspace directions: none (2,0,0) (0,1,0) (0,0,1)\n"
        f"kinds: list domain domain domain\nencoding: gzip\nspace origin: (1,2,3)\n{described}\n"
    )
    return header.encode() + gzip.compress(np.stack(layers).astype(np.uint8).tobytes(order="F"))
