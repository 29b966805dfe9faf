"""Compressed streams, against the standard library's own files."""

import bz2
import gzip
import io
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.adapters.inflating import MAX_STREAMS, PIECE, inflating

COMPRESS = {"gzip": gzip.compress, "bzip2": bz2.compress, "zlib": zlib.compress}
CHAINED = ["gzip", "bzip2"]


def read_all(data, encoding, size=1000):
    stream = inflating(io.BytesIO(data), encoding)
    pieces = []
    while piece := stream.read(size):
        assert len(piece) <= size
        pieces.append(piece)
    return b"".join(pieces)


@given(st.sampled_from(CHAINED), st.lists(st.binary(max_size=300), min_size=1, max_size=5), st.integers(1, 400))
def test_streams_that_follow_each_other_are_one(encoding, parts, size):
    data = b"".join(COMPRESS[encoding](part) for part in parts)
    assert read_all(data, encoding, size) == b"".join(parts)


@pytest.mark.parametrize("encoding", [*COMPRESS, "raw"])
def test_data_of_many_pieces_are_read_whole(encoding):
    whole = bytes(range(256)) * 4096 + bytes(4 * PIECE)
    assert read_all(COMPRESS.get(encoding, bytes)(whole), encoding, 1 << 16) == whole


def test_zeros_after_a_stream_are_padding():
    data = gzip.compress(b"one") + bytes(3 * PIECE) + gzip.compress(b"two") + bytes(9)
    assert read_all(data, "gzip") == b"onetwo"


def test_what_follows_a_stream_of_zlib_is_left():
    assert read_all(zlib.compress(b"one") + b"anything", "zlib") == b"one"


@pytest.mark.parametrize("encoding", COMPRESS)
def test_a_stream_cut_anywhere_is_damaged(encoding):
    data = COMPRESS[encoding](bytes(range(200)))
    for end in range(len(data)):
        with pytest.raises((EOFError, OSError, zlib.error)):
            read_all(data[:end], encoding)


@pytest.mark.parametrize("encoding", CHAINED)
def test_other_data_after_a_stream_are_damage(encoding):
    with pytest.raises((OSError, zlib.error)):
        read_all(COMPRESS[encoding](b"one") + b"anything", encoding)


@pytest.mark.parametrize("encoding", CHAINED)
def test_the_number_of_streams_is_limited(encoding):
    empty = COMPRESS[encoding](b"")
    assert read_all(empty * (MAX_STREAMS - 1) + COMPRESS[encoding](b"last"), encoding) == b"last"
    with pytest.raises(OSError, match="streams"):
        read_all(empty * (MAX_STREAMS + 1), encoding)
