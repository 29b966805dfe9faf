"""Files by key in a folder: written under another name and renamed, so that nobody meets half of one."""

import os
import shutil
import uuid
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import BinaryIO

from model.interruption import Check, unchecked

_TEMPORARY = ".tmp-"


class FolderBlobs:
    """The `BlobStore` on a folder of the file system, readable by its owner alone."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def put(self, key: str, data: bytes) -> None:
        """Write a file, over an older one; on the disk when this returns."""
        self._write(key, lambda file: file.write(data))

    def put_file(self, key: str, file: BinaryIO) -> None:
        """Write a copy of an open file from its beginning."""
        file.seek(0)
        self._write(key, lambda target: shutil.copyfileobj(file, target))

    def get(self, key: str) -> bytes:
        """Content of a file; `FileNotFoundError` when it is not there."""
        return self._path(key).read_bytes()

    def exists(self, key: str) -> bool:
        """Whether a file is there."""
        return self._path(key).is_file()

    def list(self, prefix: str) -> Iterable[str]:
        """Keys below a folder; folders that others remove meanwhile are passed over."""
        for folder, _, names in os.walk(self._path(prefix)):
            for name in names:
                if not name.startswith(_TEMPORARY):
                    yield (Path(folder) / name).relative_to(self._folder).as_posix()

    def folders(self, prefix: str) -> Iterable[str]:
        """Names of the folders in a folder."""
        try:
            with os.scandir(self._path(prefix)) as entries:
                return [entry.name for entry in entries if entry.is_dir()]
        except FileNotFoundError:
            return []

    def delete(self, prefix: str, check: Check = unchecked) -> None:
        """Remove everything below a folder; the check passes once, before."""
        check()
        shutil.rmtree(self._path(prefix), ignore_errors=True)

    def _write(self, key: str, write: Callable[[BinaryIO], object]) -> None:
        target = self._path(key)
        target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        temporary = target.with_name(f"{_TEMPORARY}{uuid.uuid4().hex}")
        try:
            with temporary.open("xb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise

    def _path(self, key: str) -> Path:
        if any(part in ("", ".", "..") for part in key.rstrip("/").split("/")):
            raise ValueError("A key consists of names, separated by slashes.")
        return self._folder / key
