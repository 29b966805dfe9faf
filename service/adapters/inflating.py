"""Compressed streams (gzip, zlib, bzip2) inflated a bounded piece at a time.

A file of gzip or bzip2 may chain streams, and a stranger's may chain millions of empty ones: so many cost minutes
before the first byte comes out, so their number is limited.
"""

import bz2
import zlib
from collections.abc import Callable
from typing import BinaryIO, Protocol

#: Compressed bytes read at a time.
PIECE = 1 << 16
#: Most streams that one file may chain; block gzip of the largest images has fewer.
MAX_STREAMS = 1 << 15


class Readable(Protocol):
    """What can be read a piece at a time."""

    def read(self, size: int, /) -> bytes:
        """At most so many bytes; empty at the end."""


def inflating(file: BinaryIO, encoding: str) -> Readable:
    """What a file holds from its position on.

    Args:
        encoding: ``gzip``, ``zlib`` (one stream, whatever follows), ``bzip2``, or ``raw`` for the file as it is.
    """
    return file if encoding == "raw" else _Inflating(file, _STREAMS[encoding], chained=encoding != "zlib")


class _Stream(Protocol):
    """A stream that is being inflated, as `bz2` has it."""

    @property
    def eof(self) -> bool: ...
    @property
    def needs_input(self) -> bool: ...
    @property
    def unused_data(self) -> bytes: ...
    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


class _Inflate:
    """A stream of zlib or gzip with the methods of one of bzip2."""

    def __init__(self, window: int) -> None:
        self._stream = zlib.decompressobj(window)

    @property
    def eof(self) -> bool:
        return self._stream.eof

    @property
    def needs_input(self) -> bool:
        return not self._stream.unconsumed_tail

    @property
    def unused_data(self) -> bytes:
        return self._stream.unused_data

    def decompress(self, data: bytes, max_length: int, /) -> bytes:
        return self._stream.decompress(self._stream.unconsumed_tail + data, max_length)


_STREAMS: dict[str, Callable[[], _Stream]] = {
    "gzip": lambda: _Inflate(zlib.MAX_WBITS | 16),
    "zlib": lambda: _Inflate(zlib.MAX_WBITS),
    "bzip2": bz2.BZ2Decompressor,
}


class _Inflating:
    def __init__(self, file: BinaryIO, begin: Callable[[], _Stream], *, chained: bool) -> None:
        self._file, self._begin = file, begin
        self._stream, self._held = begin(), b""
        self._streams_left = MAX_STREAMS - 1 if chained else 0
        self._chained = chained

    def read(self, size: int, /) -> bytes:
        """At most so many bytes; empty after the last stream.

        Raises:
            EOFError: the file ends within a stream.
            OSError, zlib.error: a damaged stream, or over `MAX_STREAMS` of them.
        """
        data = b""
        while not data and self._has_more():
            if self._stream.needs_input and not self._held:
                self._held = self._file.read(PIECE)
                if not self._held:
                    raise EOFError
            data, self._held = self._stream.decompress(self._held, size), b""
        return data

    def _has_more(self) -> bool:
        """Whether a stream goes on or another one follows, which is begun."""
        if self._stream.eof and self._chained:
            self._held = self._after_padding(self._stream.unused_data)
            if self._held:
                self._begin_next()
        return not self._stream.eof

    def _after_padding(self, data: bytes) -> bytes:
        """The data without the zeros that may fill the space after a stream; the file's next ones when none is left."""
        data = data.lstrip(b"\0")
        while not data and (piece := self._file.read(PIECE)):
            data = piece.lstrip(b"\0")
        return data

    def _begin_next(self) -> None:
        if not self._streams_left:
            raise OSError(f"over {MAX_STREAMS} streams")
        self._streams_left -= 1
        self._stream = self._begin()
