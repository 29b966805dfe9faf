"""The masks of a ZIP that was sent: which of its members they are, and how much they may hold together."""

import io
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from model.errors import InputError, InvalidParameter, TooLarge, UnreadableImage

#: Files of an archive or a folder with these endings are masks; others are left out.
MASK_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".mha", ".mhd", ".dcm")
#: What the library raises over an archive or a member that is damaged, encrypted or of an unknown form.
_DAMAGED = (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, zlib.error, ValueError, OSError)
#: Others are inflated without a bound by the library.
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1
#: Room that a mask may take in the list of members, with what systems put beside it.
MEMBER_BYTES = 512
_CHUNK = 1 << 20


@dataclass(frozen=True)
class ArchiveLimits:
    """What the masks of one archive may cost.

    Attributes:
        max_masks: how many there may be.
        max_mask_bytes: of one of them, unpacked.
        max_bytes: of all of them together, unpacked.
    """

    max_masks: int
    max_mask_bytes: int
    max_bytes: int


@dataclass(frozen=True)
class ArchivedMask:
    """A mask of an archive: its content, or why it has none that can be used."""

    name: str
    content: bytes = b""
    problem: InputError | None = None


class _ShortReads(io.RawIOBase):
    """An archive of which nothing is read that is longer than the list of members may be: that is read at once."""

    def __init__(self, archive: BinaryIO, most: int) -> None:
        self._archive = archive
        self._most = most

    def read(self, size: int = -1) -> bytes:
        if size > self._most:
            raise TooLarge("The archive's list of members is longer than that of any job's masks.", part="archive")
        return self._archive.read(size)

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        return self._archive.seek(offset, whence)

    def tell(self) -> int:
        return self._archive.tell()

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True


def open_archive(archive: BinaryIO, limits: ArchiveLimits) -> zipfile.ZipFile:
    """The archive with the list of its members read.

    Raises:
        InvalidParameter: not a ZIP, or one whose list of members is damaged.
        TooLarge: a list that is longer than so many masks need, whatever else is beside them.
    """
    try:
        return zipfile.ZipFile(_ShortReads(archive, max(limits.max_masks * MEMBER_BYTES, _CHUNK)))
    except _DAMAGED:
        raise InvalidParameter("The part archive must be a ZIP that is whole.", part="archive") from None


def masks_of(opened: zipfile.ZipFile, limits: ArchiveLimits) -> list[zipfile.ZipInfo]:
    """The members that are masks, in the order of their names.

    Raises:
        TooLarge: more of them than a job may have, or more bytes together, as the list of members says.
    """
    found = sorted((info for info in opened.infolist() if _is_mask(info)), key=lambda info: info.filename)
    if len(found) > limits.max_masks:
        raise TooLarge(f"The archive must not hold more than {limits.max_masks} masks.", part="archive")
    _require_room(sum(info.file_size for info in found if info.file_size <= limits.max_mask_bytes), limits)
    return found


def masks_in(archive: BinaryIO, limits: ArchiveLimits) -> Iterator[ArchivedMask]:
    """The masks of an archive, one in memory at a time; one at fault stops no other.

    Raises:
        InvalidParameter, TooLarge: see `open_archive` and `masks_of`.
    """
    unpacked = 0
    with open_archive(archive, limits) as opened:
        for info in masks_of(opened, limits):
            mask = _read(opened, info, limits)
            unpacked += len(mask.content)
            _require_room(unpacked, limits)
            yield mask


def zip_of_folder(folder: Path, target: BinaryIO) -> None:
    """Write the masks below a folder as a ZIP, under their names relative to it."""
    with zipfile.ZipFile(target, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.name.lower().endswith(MASK_SUFFIXES) and not path.name.startswith("."):
                archive.write(path, path.relative_to(folder).as_posix())


def _require_room(size: int, limits: ArchiveLimits) -> None:
    if size > limits.max_bytes:
        raise TooLarge(
            f"The masks of the archive must not hold more than {limits.max_bytes} bytes together.", part="archive"
        )


def _read(opened: zipfile.ZipFile, info: zipfile.ZipInfo, limits: ArchiveLimits) -> ArchivedMask:
    problem = _refusal(info, limits)
    if problem is not None:
        return ArchivedMask(info.filename, problem=problem)
    content = bytearray()
    try:
        with opened.open(info) as member:
            while len(content) <= limits.max_mask_bytes and (piece := member.read(_CHUNK)):
                content += piece
    except _DAMAGED:
        damaged = UnreadableImage("The mask is damaged in the archive; pack it anew.", part="mask")
        return ArchivedMask(info.filename, problem=damaged)
    return ArchivedMask(info.filename, bytes(content))


def _refusal(info: zipfile.ZipInfo, limits: ArchiveLimits) -> InputError | None:
    """Why a mask is not even unpacked; None when it is."""
    if info.file_size > limits.max_mask_bytes:
        return TooLarge(
            f"The mask is larger than {limits.max_mask_bytes} bytes, the most that is accepted.", part="mask"
        )
    if info.flag_bits & _ENCRYPTED:
        return UnreadableImage("The mask is encrypted in the archive; a ZIP without password is accepted.", part="mask")
    if info.compress_type not in _METHODS:
        unusual = "The mask is compressed in an unusual way; members of a ZIP must be stored or deflated."
        return UnreadableImage(unusual, part="mask")
    return None


def left_out(archive: BinaryIO, limits: ArchiveLimits) -> list[str]:
    """Names of the files that are taken for no masks, but for hidden ones, in their order."""
    with open_archive(archive, limits) as opened:
        return sorted(info.filename for info in opened.infolist() if _is_shown(info) and not _is_mask(info))


def _is_mask(info: zipfile.ZipInfo) -> bool:
    """By the end of its name; objects of DICOM often have names without one."""
    name = PurePosixPath(info.filename).name
    return _is_shown(info) and (name.lower().endswith(MASK_SUFFIXES) or "." not in name)


def _is_shown(info: zipfile.ZipInfo) -> bool:
    hidden = any(part.startswith((".", "__MACOSX")) for part in PurePosixPath(info.filename).parts)
    return not info.is_dir() and not hidden
