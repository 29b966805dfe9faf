"""Bad inputs, each with the error and HTTP status it must meet.

One table for tests of the reader, the interface and the command line::

    for bad in bad_inputs():
        files = bad.files()      # one bytes object a mask part
        bad.fields               # form fields beside them, for example {"label": "7"}
"""

import bz2
import gzip
import io
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import nibabel as nib
import numpy as np

from model.errors import (
    InconsistentStacks,
    InputError,
    InvalidGeometry,
    InvalidMask,
    InvalidParameter,
    TooLarge,
    UnreadableImage,
)
from service.adapters.images import ImageLimits

#: Under these limits every row meets its error; the well-formed rows are far smaller.
LIMITS = ImageLimits(max_bytes=1 << 24, max_voxels=1 << 22)
#: Words hidden in headers of bad inputs; no message may repeat them.
SECRET = "Doe^Jane-4711"


@dataclass(frozen=True)
class BadInput:
    """One way to be wrong.

    Attributes:
        name: for test ids.
        files: builds the mask parts.
        error: class that is raised.
        status: HTTP status that answers it.
        fields: form fields beside the masks.
        suffix: file name ending that fits the content, for the command line.
    """

    name: str
    files: Callable[[], Sequence[bytes]]
    error: type[InputError]
    status: int
    fields: dict[str, str] = field(default_factory=dict)
    suffix: str = ".nii.gz"


def bad_inputs() -> tuple[BadInput, ...]:
    """The table."""
    return (
        BadInput("empty file", lambda: [b""], UnreadableImage, 415),
        BadInput(
            "not an image", lambda: [b"Dear all, please find attached " * 40], UnreadableImage, 415, suffix=".txt"
        ),
        BadInput("random bytes", _random_bytes, UnreadableImage, 415),
        BadInput("random bytes, gzip", lambda: [gzip.compress(_random_bytes()[0])], UnreadableImage, 415),
        BadInput("truncated gzip", lambda: [nifti(drawn())[:-40]], UnreadableImage, 415),
        BadInput("gzip cut within the header", lambda: [nifti(drawn())[:30]], UnreadableImage, 415),
        BadInput("damaged gzip", _damaged_gzip, UnreadableImage, 415),
        BadInput("truncated NIfTI", lambda: [nifti(drawn(), zipped=False)[:-9]], UnreadableImage, 415, suffix=".nii"),
        BadInput("half of a NIfTI pair", lambda: [_patched(magic=b"ni1")], UnreadableImage, 415),
        BadInput("negative extents", lambda: [_patched(dim=[3, -4, 5, 6, 1, 1, 1, 1])], UnreadableImage, 415),
        BadInput("unknown voxel type", lambda: [_patched(datatype=99)], UnreadableImage, 415),
        BadInput("voxels that begin nowhere", lambda: [_patched(vox_offset=np.nan)], UnreadableImage, 415),
        BadInput("10^12 voxels claimed", lambda: [_patched(dim=[3, 10000, 10000, 10000, 1, 1, 1, 1])], TooLarge, 413),
        BadInput("2^84 voxels claimed", lambda: [_patched(dim=[7, *[4096] * 7])], TooLarge, 413),
        BadInput("10^12 voxels claimed, NRRD", lambda: [nrrd_text("10000 10000 10000")], TooLarge, 413, suffix=".nrrd"),
        BadInput("10^12 voxels, MetaImage", lambda: [mha_text(size="10000 10000 10000")], TooLarge, 413, suffix=".mha"),
        BadInput("gzip bomb", _gzip_bomb, TooLarge, 413),
        BadInput("bzip2 bomb, NRRD", _bzip2_bomb, TooLarge, 413, suffix=".nrrd"),
        BadInput("zlib bomb, MetaImage", _zlib_bomb, TooLarge, 413, suffix=".mha"),
        BadInput("more bytes than accepted", lambda: [bytes(LIMITS.max_bytes + 1)], TooLarge, 413),
        BadInput("NaN affine", lambda: [_patched(srow_x=[np.nan, 0, 0, 0])], InvalidGeometry, 422),
        BadInput("zero spacing", lambda: [_patched(pixdim=[1, 0, 1, 1, 1, 1, 1, 1])], InvalidGeometry, 422),
        BadInput("NaN spacing", lambda: [_patched(pixdim=[1, np.nan, 1, 1, 1, 1, 1, 1])], InvalidGeometry, 422),
        BadInput("zero affine", lambda: [_patched(srow_z=[0, 0, 0, 0])], InvalidGeometry, 422),
        BadInput("sheared affine", lambda: [nifti(drawn(), affine=sheared())], InvalidGeometry, 422),
        BadInput(
            "zero spacing, NRRD",
            lambda: [nrrd_text("6 7 8", "(0,0,0) (0,1,0) (0,0,1)")],
            InvalidGeometry,
            422,
            suffix=".nrrd",
        ),
        BadInput(
            "unknown space, NRRD",
            lambda: [nrrd_text("6 7 8", space="scanner-xyz")],
            InvalidGeometry,
            422,
            suffix=".nrrd",
        ),
        BadInput("zero spacing, MetaImage", lambda: [mha_text(spacing="1 0 1")], InvalidGeometry, 422, suffix=".mha"),
        BadInput("no foreground", lambda: [nifti(np.zeros((6, 7, 8), np.uint8))], InvalidMask, 422),
        BadInput("one slice only", lambda: [nifti(drawn(slices=(4,)))], InvalidMask, 422),
        BadInput("2-D image", lambda: [nifti(np.ones((6, 7), np.uint8))], InvalidMask, 422),
        BadInput("4-D image", lambda: [nifti(np.ones((6, 7, 8, 2), np.uint8))], InvalidMask, 422),
        BadInput("colour image", lambda: [_patched(datatype=128, bitpix=24)], InvalidMask, 422),
        BadInput("soft values", lambda: [nifti(drawn().astype(np.float32) * 0.4)], InvalidMask, 422),
        BadInput("NaN values", lambda: [nifti(np.where(drawn() > 0, np.nan, 0).astype(np.float32))], InvalidMask, 422),
        BadInput("negative values", lambda: [nifti(-drawn().astype(np.int16))], InvalidMask, 422),
        BadInput("255 everywhere", lambda: [nifti(np.full((6, 7, 8), 255, np.uint8))], InvalidMask, 422),
        BadInput("a picture", _picture, InvalidMask, 422),
        BadInput("label absent", lambda: [nifti(drawn())], InvalidMask, 422, fields={"label": "7"}),
        BadInput("label 255", lambda: [nifti(drawn())], InvalidParameter, 422, fields={"label": "255"}),
        BadInput("label 0", lambda: [nifti(drawn())], InvalidParameter, 422, fields={"label": "0"}),
        BadInput("two files in different worlds", _different_worlds, InconsistentStacks, 422),
        BadInput(
            "MetaImage with an external file",
            lambda: [mha_text(data_file="/etc/hostname")],
            UnreadableImage,
            415,
            suffix=".mha",
        ),
        BadInput("NRRD with an external file", _detached_nrrd, UnreadableImage, 415, suffix=".nrrd"),
        BadInput("NRRD header by itself", lambda: [_detached_header()], UnreadableImage, 415, suffix=".nhdr"),
        BadInput("65 axes", lambda: [many_axes_mha(65)], InvalidMask, 422, suffix=".mha"),
        BadInput("5000 axes", lambda: [many_axes_mha(5000)], InvalidMask, 422, suffix=".mha"),
        BadInput("65 axes, NRRD", lambda: [many_axes_nrrd(65)], InvalidMask, 422, suffix=".nrrd"),
        BadInput("5000 axes, NRRD", lambda: [many_axes_nrrd(5000)], UnreadableImage, 415, suffix=".nrrd"),
        BadInput("one slice in two files", lambda: [nifti(drawn(slices=(4,)))] * 2, InvalidMask, 422),
        BadInput("truncated NRRD", lambda: [nrrd_text("6 7 8")[:-1]], UnreadableImage, 415, suffix=".nrrd"),
        BadInput("truncated MetaImage", lambda: [mha_text()[:-1]], UnreadableImage, 415, suffix=".mha"),
        BadInput("NRRD header without end", lambda: [b"NRRD0004\ntype: uchar\n"], UnreadableImage, 415, suffix=".nrrd"),
        BadInput(
            "MetaImage header without end",
            lambda: [b"ObjectType = Image\nNDims = 3\n"],
            UnreadableImage,
            415,
            suffix=".mha",
        ),
    )


def sheared() -> np.ndarray:
    """First and second axis are not perpendicular."""
    return np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def drawn(slices: Sequence[int] = (2, 5)) -> np.ndarray:
    """A small sound mask, (6, 7, 8): label 1 on some planes along the last axis."""
    values = np.zeros((6, 7, 8), np.uint8)
    values[1:5, 2:6, list(slices)] = 1
    return values


def nifti(values: np.ndarray, affine: np.ndarray | None = None, *, zipped: bool = True) -> bytes:
    """A NIfTI-1 whose header carries `SECRET`."""
    image = nib.Nifti1Image(values, np.eye(4) if affine is None else affine)
    image.header["descrip"] = SECRET.encode()
    data = image.to_bytes()
    return gzip.compress(data, mtime=0) if zipped else data


def _patched(**changes: object) -> bytes:
    """A sound NIfTI with some header fields replaced, whatever they break."""
    data = bytearray(nifti(drawn(), zipped=False))
    header = nib.Nifti1Header(bytes(data[:348]), check=False)
    for name, value in changes.items():
        header[name] = value
    data[:348] = header.binaryblock
    return gzip.compress(bytes(data), mtime=0)


def _random_bytes() -> list[bytes]:
    return [np.random.default_rng(0).bytes(4096)]


def _damaged_gzip() -> list[bytes]:
    whole = bytearray(nifti(np.random.default_rng(0).integers(0, 2, (6, 7, 80)).astype(np.uint8)))
    whole[-30:-20] = bytes(10)
    return [bytes(whole)]


def _gzip_bomb() -> list[bytes]:
    """A sound header followed by 64 MiB of zeros, in some 60 kB."""
    packed = io.BytesIO()
    with gzip.GzipFile(fileobj=packed, mode="wb", mtime=0) as stream:
        stream.write(nifti(drawn(), zipped=False))
        for _ in range(64):
            stream.write(bytes(1 << 20))
    return [packed.getvalue()]


def _bzip2_bomb() -> list[bytes]:
    return [nrrd_text("6 7 8", encoding="bzip2", data=bz2.compress(bytes(1 << 24)))]


def _zlib_bomb() -> list[bytes]:
    return [mha_text(compressed="True", data=zlib.compress(bytes(1 << 24)))]


def _picture() -> list[bytes]:
    return [nifti(np.arange(6 * 7 * 8, dtype=np.int16).reshape(6, 7, 8))]


def _different_worlds() -> list[bytes]:
    elsewhere = np.eye(4)
    elsewhere[:3, 3] = (0, 0, 400.0)
    return [nifti(drawn()), nifti(drawn(), elsewhere)]


def nrrd_text(
    sizes: str,
    directions: str = "(1,0,0) (0,1,0) (0,0,1)",
    *,
    space: str = "left-posterior-superior",
    encoding: str = "raw",
    data: bytes | None = None,
) -> bytes:
    """An NRRD written by hand; its voxels are `drawn` unless given."""
    header = (
        f"NRRD0004\n# {SECRET}\ntype: uchar\ndimension: 3\nspace: {space}\nsizes: {sizes}\n"
        f"space directions: {directions}\nkinds: domain domain domain\nendian: little\nencoding: {encoding}\n"
        f"space origin: (0,0,0)\nSegment0_Name:={SECRET}\n\n"
    )
    return header.encode() + (drawn().tobytes(order="F") if data is None else data)


def _detached_nrrd() -> list[bytes]:
    return [nrrd_text("6 7 8").replace(b"encoding:", b"data file: /etc/hostname\nencoding:")]


def _detached_header() -> bytes:
    """As writers of .nhdr leave it: the last field ends the file."""
    return _detached_nrrd()[0].partition(b"\n\n")[0] + b"\n"


def many_axes_mha(axes: int) -> bytes:
    """A MetaImage of `drawn` with more axes, all of one voxel."""
    text = mha_text(size="6 7 8" + " 1" * (axes - 3), spacing=" ".join(["1"] * axes)).replace(
        b"NDims = 3", b"NDims = %d" % axes
    )
    return b"".join(
        line for line in text.splitlines(keepends=True) if not line.startswith((b"Offset", b"TransformMatrix"))
    )


def many_axes_nrrd(axes: int) -> bytes:
    """An NRRD of `drawn` with more axes, all of one voxel."""
    return nrrd_text("6 7 8" + " 1" * (axes - 3)).replace(b"dimension: 3", b"dimension: %d" % axes)


def mha_text(
    *,
    size: str = "6 7 8",
    spacing: str = "1 1 1",
    compressed: str = "False",
    data_file: str = "LOCAL",
    data: bytes | None = None,
) -> bytes:
    """A MetaImage written by hand; its voxels are `drawn` unless given."""
    header = (
        f"ObjectType = Image\nNDims = 3\nComment = {SECRET}\nBinaryData = True\nBinaryDataByteOrderMSB = False\n"
        f"CompressedData = {compressed}\nTransformMatrix = 1 0 0 0 1 0 0 0 1\nOffset = 0 0 0\n"
        f"ElementSpacing = {spacing}\nDimSize = {size}\nElementType = MET_UCHAR\nElementDataFile = {data_file}\n"
    )
    return header.encode() + (drawn().tobytes(order="F") if data is None else data)
